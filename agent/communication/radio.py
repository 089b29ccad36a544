"""What an agent knows of the team's radio: which plans and proposals have come through the air."""

import numpy as np
from msgspec.structs import replace

from transport.protocol.admission.delayed_messages import Arrivals
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.wire.messages import REPLACED, UNREPORTED, Airtime, Plan
from transport.protocol.wire.names import agent_name

Iteration = tuple[int, int]  # tick, and exchanges that follow within it


class AirNews:
    """Reports of the radio for one agent, 1-based. They outlast a new start of the agent."""

    def __init__(self, agent: int, section: RadioSection) -> None:
        self.tick = 0  # until which reports are here
        self._agent = agent
        self._hears_first_input = section.inputs == "first"
        self._heard: dict[Iteration, set[int]] = {}  # senders of proposals that came in time

    def take(self, report: Airtime, plans: Arrivals[Plan]) -> None:
        """Note which plans have come through the air, and which proposals of an exchange."""
        heard = set()
        arrivals_s = report.arrivals[:, self._agent - 1].tolist()
        rows = zip(report.agents, report.plan_ticks, report.exchanges, arrivals_s, strict=True)
        for sender, tick, exchange, arrival_s in rows:
            if arrival_s == UNREPORTED:
                continue
            if arrival_s == REPLACED:
                plans.withdraw(agent_name(sender), tick)
            elif exchange == 0:
                plans.air(agent_name(sender), tick, arrival_s if arrival_s >= 0.0 else None)
            elif (tick, exchange) == (report.tick, report.negotiation) and arrival_s >= 0.0:
                heard.add(sender)

        if report.negotiation > 0:
            self._heard[report.tick, report.negotiation] = heard
        else:
            self.tick = report.tick

    def is_decided(self, iteration: Iteration) -> bool:
        """Return whether the report of an exchange is here."""
        return iteration in self._heard

    def heard(self, iteration: Iteration) -> set[int]:
        """Return the agents whose proposals came through the air before the end of an exchange."""
        return self._heard.get(iteration, set())

    def heard_plan(self, plan: Plan) -> Plan:
        """Return a plan as the radio has carried it: with all inputs, or with the first one held."""
        if not self._hears_first_input:
            return plan
        return replace(plan, inputs=np.repeat(plan.inputs[:1], len(plan.inputs), axis=0))

    def forget_before(self, tick: int) -> None:
        """Forget the exchanges of earlier ticks."""
        self._heard = {key: heard for key, heard in self._heard.items() if key[0] >= tick}
