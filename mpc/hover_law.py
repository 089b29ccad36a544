"""The control law of a team about its hover: regulator, steady state under forces and their preview."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from transport.model.arrays import Array, padded
from transport.model.hover import Hover, failed_hover
from transport.model.identity import digest
from transport.model.linearisation import Model
from transport.model.state import input_slice
from transport.mpc import feedback
from transport.mpc.cost import Cost
from transport.mpc.expressions import UserCosts
from transport.mpc.fail_safe import FailSafe
from transport.mpc.feedback import Regulator, Target, at_rest
from transport.mpc.settings import ControllerSettings
from transport.mpc.shared import SharedResults


class Team(NamedTuple):
    """UAVs, 0-based, without an agent, without motors, and of these the released ones."""

    gone: frozenset[int] = frozenset()
    off: frozenset[int] = frozenset()
    released: frozenset[int] = frozenset()


class Crew:
    """The whole team and the settings of its controllers: what all control laws of a run share."""

    def __init__(self, model: Model, hover: Hover, settings: ControllerSettings) -> None:
        self.model = model
        self.hover = hover
        self.settings = settings
        terms = (*settings.cost, *settings.weights.terms(model.system.N))
        self.user_costs = UserCosts(terms, model.system)

    @property
    def key(self) -> bytes:
        """Digest of the numbers that control laws follow from."""
        kind = type(self.model).__qualname__
        return digest(kind, self.model.system, self.hover, repr(self.settings))

    @property
    def needs_regulator(self) -> bool:
        """Whether controllers with these settings use a shared control law or its cost-to-go."""
        return self.settings.prediction == "closed_loop" or self.settings.terminal == "riccati"


@dataclass(frozen=True, kw_only=True, eq=False)
class HoverLaw:
    """The control law of a team about the hover that its UAVs with motors can hold."""

    key: bytes  # digest of what the law follows from
    crew: Crew
    team: Team
    model: Model  # without the motors of UAVs off
    hover: Hover
    cost: Cost
    uncontrolled: Mapping[int, Array]  # fail-safe gains of UAVs without an agent, (4, n)
    regulator: Regulator | None  # None if the settings need none

    @cached_property
    def target(self) -> Target:
        """Steady state under external forces. Source: docs/equations.md (40)."""
        return feedback.target(
            self.model,
            self.hover,
            self.cost,
            self.uncontrolled,
            self.team.off,
            self.team.released,
        )

    @cached_property
    def forced(self) -> tuple[Array, Array]:
        """Feedforward, (m, F), and slope of the cost-to-go, (n, F), per newton.

        They answer to outputs that the target misses: p = A_closed' p + C'Q C M_x.
        Source: docs/equations.md (40a).
        """
        if self.regulator is None:
            raise feedback.FeedbackError("expected a shared control law, got none")
        regulator = self.regulator
        M_x = self.target.M_x
        C = self.model.linearise(self.hover.x, self.hover.u).C
        terms = self.crew.user_costs.about(self.hover.x)
        missed = C.T @ (self.cost.Q[:, None] * (C @ M_x)) + terms.T @ (terms @ M_x)

        pull = padded(missed.T, len(regulator.T)).T
        p = at_rest(regulator, regulator.T.T @ pull)
        feedforward = np.zeros_like(self.target.M_u)
        feedforward[regulator.controlled] = regulator.preview_gain @ p
        return feedforward, regulator.T @ p


_HOVER_LAWS: SharedResults[HoverLaw] = SharedResults()


def hover_law(crew: Crew, fail_safe: FailSafe, team: Team) -> HoverLaw:
    """Return the law of a team about hover; UAVs without agents follow the fail-safe, (45), (50).

    Raises: ParameterError: the team has no hover. FeedbackError: no gain stabilises it.
    """
    key = digest(crew.key, fail_safe.follows, team)
    return _HOVER_LAWS.get(key, lambda: _hover_law(key, crew, fail_safe, team))


def _hover_law(key: bytes, crew: Crew, fail_safe: FailSafe, team: Team) -> HoverLaw:
    """Return the law of a team about hover, anew."""
    # A UAV without motors has no fail-safe.
    uncontrolled = {uav: fail_safe.gain(uav) for uav in team.gone - team.off}
    model = crew.model
    hover = crew.hover
    if team.off:
        system = crew.model.system
        thrusts = fail_safe.u_hover
        held = {uav: float(thrusts[input_slice(uav)][0]) for uav in uncontrolled}
        model = Model(system, team.off, team.released)
        hover = failed_hover(system, team.off, team.released, held)

    settings = crew.settings
    cost = Cost(settings.weights, crew.model.system, hover, team.off, team.released)
    regulator = None
    if crew.needs_regulator:
        regulator = feedback.regulator(
            model,
            hover,
            cost,
            settings.sampling_period_s,
            uncontrolled,
            crew.user_costs.about(hover.x),
            team.off,
            team.released,
            settings.motor_lag_s,
        )
    return HoverLaw(
        key=key,
        crew=crew,
        team=team,
        model=model,
        hover=hover,
        cost=cost,
        uncontrolled=uncontrolled,
        regulator=regulator,
    )
