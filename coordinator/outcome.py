"""Outcome of a run by its plans and the plant's states: diverged, collided, failed or completed."""

from collections import Counter, defaultdict

from transport.protocol.scenario.setup.collisions import Contacts
from transport.protocol.wire.errors_and_exit_codes import EXIT_COLLIDED, EXIT_DIVERGED, EXIT_FAILED
from transport.protocol.wire.message_form import MAX_TEXT
from transport.protocol.wire.messages import Plan, PlantState
from transport.protocol.wire.names import agent_names


class FailedSteps:
    """Steps and failed steps of each agent, counted by the status of its plans.

    The limit holds for each agent: in the mean over a large team an agent whose controller never
    works would not show.

    Attributes:
        allowed: Largest share of an agent's steps that may fail (`agents.failed_share`).
    """

    def __init__(self, allowed: float) -> None:
        self.allowed = allowed
        self._steps = Counter[int]()
        self._failed = Counter[int]()

    def count(self, plan: Plan) -> None:
        """Count one step of an agent by its last plan of a tick."""
        self._steps[plan.agent] += 1

        if plan.status != "solved":
            self._failed[plan.agent] += 1

    def verdict(self) -> str:
        """Return a sentence about all failed agents if one has failed too often, otherwise "".

        Agents with equal counts are named together. In a team too large for one message the
        sentence has the number of agents and the worst of them.
        """
        shares = {agent: self._failed[agent] / self._steps[agent] for agent in self._failed}
        worst = max(sorted(shares), key=lambda agent: shares[agent], default=None)
        if worst is None or shares[worst] <= self.allowed:
            return ""

        agents_by_count = defaultdict[tuple[int, int], list[int]](list)
        for agent in sorted(self._failed):
            agents_by_count[self._failed[agent], self._steps[agent]].append(agent)

        limit = f"at most {100.0 * self.allowed:.4g} % of an agent's steps may fail"
        by_count = [
            f"{agent_names(agents)} failed in {_of(*counts)}{' each' if len(agents) > 1 else ''}"
            for counts, agents in agents_by_count.items()
        ]
        text = f"{'; '.join(by_count)}; {limit}"
        if len(text) <= MAX_TEXT:
            return text

        counts_of_worst = _of(self._failed[worst], self._steps[worst])
        return f"{len(shares)} agents failed, {agent_names([worst])} in {counts_of_worst}; {limit}"


def _of(failed: int, steps: int) -> str:
    """Return a count of failed steps in words."""
    return f"{failed} of {steps} steps"


class Verdict:
    """Outcome of a run so far, from the messages that the coordinator receives."""

    def __init__(self, contacts: Contacts, failed_share: float, *, ends_by_contact: bool) -> None:
        self._contacts = contacts
        self._ends_by_contact = ends_by_contact  # `plant.on_collision`
        self._divergence = ""  # why the run has diverged, by the plant's first such state
        self._failed_steps = FailedSteps(failed_share)

    def add_plan(self, plan: Plan) -> None:
        """Take in the last plan of an agent in a tick."""
        self._failed_steps.count(plan)

    def add_plant_state(self, plant_state: PlantState, time: str) -> bool:
        """Take in a state of the plant and its time as text; return whether the run ends by it."""
        diverges = bool(plant_state.diverged) and not self._divergence
        if diverges:
            self._divergence = f"{plant_state.diverged} at {time}"
        collides = self._contacts.add(plant_state) is not None
        return diverges or (collides and self._ends_by_contact)

    def outcome(self) -> tuple[int, str]:
        """Return exit code and reason of a run that ends by the plant's states or at its last tick."""
        failure = "" if self._divergence else self._failed_steps.verdict()
        contact = self._contacts.first
        if contact is not None:
            # What came after the contact would not have happened so.
            collision = f"{contact.text} at t = {contact.at_s:.2f} s"
            reasons = [collision, self._divergence, failure]
            return EXIT_COLLIDED, "; ".join(filter(None, reasons))[:MAX_TEXT]
        if self._divergence:
            return EXIT_DIVERGED, self._divergence
        return (EXIT_FAILED, failure) if failure else (0, "")
