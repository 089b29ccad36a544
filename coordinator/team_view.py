"""The team as the coordinator sees it: what it asks about it, and the limits by which it judges."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from transport.model.arrays import Array
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.setup.collisions import Contacts
from transport.protocol.wire.messages import Plan, Target


class TargetPlanner(Protocol):
    """Timing of targets for a team that has a path, and follows the targets so far."""

    def fields(self, wanted: Any, tick: int) -> dict[str, Any]:
        """Return the fields of the message of a target from a tick on: of a script, or of a request.

        Raises: RequestError: the team cannot reach it.
        """
        ...

    def follow(self, target: Target) -> None:
        """Let the path lead to a target that is told."""
        ...


class Radio(Protocol):
    """Radio of the team: plans in, their arrivals out (`protocol.scenario.radio.team_radio.TeamRadio`)."""

    def fit_slots(self, plans: Sequence[Plan]) -> None:
        """Make the slots long enough for plans that are sent next."""
        ...

    def send(self, plan: Plan, members: Collection[int]) -> None:
        """Take in a plan that its sender shares, for the other agents on the roster."""
        ...

    def advance(self, tick: int, x: Array, *, negotiation: int = 0) -> Mapping[str, Any]:
        """Return the fields of `Airtime` for the window that ends at a tick, or with an exchange."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamView:
    """The team as the coordinator sees it, which has no model of it.

    The runtimes make it of a scenario (`transport.flight.roles.team_view`).
    """

    targets: TargetPlanner
    scripted_targets: Sequence[tuple[int, Any]] = ()  # by tick, ascending
    contacts: Contacts
    ends_by_contact: bool = False  # `plant.on_collision`
    failed_share: float  # of an agent's steps, that may fail: `agents.failed_share`
    radio: Radio | None = None
    initial_state: Array  # of the plant, (12 + 12 N,)
    # With vehicles: their settings, and the places of the UAVs at the start of the maneuver, (N, 3), m.
    vehicles: VehiclesSection | None = None
    places_I: Array | None = None
    # Outside: tick of the end of the maneuver, from which on the team comes down by itself.
    lands_at: int | None = None
