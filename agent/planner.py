"""Interface between an agent's node and its planner: this project's controller, or the user's."""

from collections.abc import Sequence
from typing import Protocol, TypeVar

from transport.agent.estimation.filter.belief import Belief
from transport.agent.received import Received
from transport.model.physics.obstacles import Obstacle
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Message, Plan
from transport.protocol.wire.outbox import Outbox

PROJECT = "mpc"  # the controller of the project


class OpenStep(Protocol):
    """A tick that has been begun and whose plan has not been made."""

    received: Received
    # Calls of `plan` still to come: all but the last of them return a proposal, and plans are exchanged.
    negotiation: int


S = TypeVar("S", bound=OpenStep)


class AgentPlanner(Protocol[S]):
    """Plans of one agent: at each tick `begin`, then `plan` and `adopt` in turns, last `plan`."""

    @property
    def belief(self) -> Belief | None:
        """Newest estimate with its covariance; None without one."""

    @property
    def share_alone(self) -> float:
        """Share, 0 to 1, with which the agent acts alone as its information is old."""

    def warm_up(self) -> None:
        """Prepare for the first step."""

    def restart(self) -> None:
        """Reset for a new start in the run."""

    def follow(self, setup: TeamRun) -> None:
        """Follow the reference of the run with a further target, from that target's tick on."""

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Take in all obstacles that UAVs of this agent have seen, once there is a new one."""

    def announce(self) -> None:
        """Send the next plan to the others, whatever it is: it carries a target."""

    def begin(self, received: Received) -> S:
        """Take in what has been received for a tick."""

    def plan(self, step: S, out: Outbox, publish_ns: int) -> list[Message]:
        """Return a proposal, or at the end of the negotiation the tick's plan and report.

        Publishing the last messages took `publish_ns`.
        """

    def adopt(self, step: S, proposals: Sequence[Plan]) -> None:
        """Take the others' proposals into the next iteration of the negotiation."""

    def end(self, tick: int, out: Outbox) -> list[Message]:
        """Return the last messages, at the end of the run."""
