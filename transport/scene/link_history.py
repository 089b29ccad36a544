"""Age of plans and packet loss of every link at any tick."""

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.scenario.links import LinkChanges
from protocol.scenario.setup import Setup
from protocol.wire.messages import LinkChange, MessageError, StepReport, agent_name

# Time before the shown tick over which losses are counted, s.
LOSS_WINDOW_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState:
    """One directed link between agents at an instant.

    Attributes:
        sender, receiver: Agents, 1-based.
        age_s: Age of the sender's newest plan that the receiver used, s; None if it used none or made no step.
        loss: Share of the sender's plans of the last `LOSS_WINDOW_S` that the link lost, 0..1.
    """

    sender: int
    receiver: int
    age_s: float | None
    loss: float


class LinkHistory:
    """Link states of one run. Losses are drawn again from the scenario, whose random generator is counter-based."""

    def __init__(self, setup: Setup) -> None:
        self._period_s = setup.settings.sampling_period_s
        self._links = {
            (sender, receiver): setup.link(agent_name(sender), agent_name(receiver))
            for sender in setup.agents
            for receiver in setup.agents
            if sender != receiver
        }
        self._changes = LinkChanges(self._links.values(), setup.samples_s)
        self._window = max(1, round(LOSS_WINDOW_S / self._period_s))
        self._lost: dict[tuple[int, int, int], bool] = {}

    def change(self, message: LinkChange) -> None:
        """Apply a link change; ignore a malformed one."""
        try:
            self._changes.apply(message)
        except MessageError:
            return
        self._lost = {key: lost for key, lost in self._lost.items() if key[2] < message.tick}

    def states(self, tick: int, reports: Sequence[StepReport]) -> tuple[LinkState, ...]:
        """Return the state of every directed link at a tick, given the reports of the agents of that tick."""
        ages = {
            (peer, report.agent): age * self._period_s
            for report in reports
            for peer, age in zip(report.peers, report.plan_ages, strict=True)
            if age >= 0
        }
        # The plan of tick k has not arrived yet.
        ticks = range(max(0, tick - self._window), max(1, tick))
        return tuple(
            LinkState(
                sender=sender,
                receiver=receiver,
                age_s=ages.get((sender, receiver)),
                loss=sum(self._is_lost(sender, receiver, k) for k in ticks) / len(ticks),
            )
            for sender, receiver in self._links
        )

    def settings(self, sender: int, receiver: int, tick: int) -> tuple[float, float]:
        """Return fixed delay, s, and loss, 0..1, of a link for the plan of a tick."""
        section = self._links[sender, receiver].impairments(tick)
        return section.delay_s, section.loss

    def _is_lost(self, sender: int, receiver: int, tick: int) -> bool:
        key = (sender, receiver, tick)
        if key not in self._lost:
            self._lost[key] = not self._links[sender, receiver].delays(tick)
        return self._lost[key]
