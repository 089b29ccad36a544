"""Parameters of the radio, from the section `[radio]` of a scenario and the run around it.

Channel, propagation, instants at which agents send, and lengths of their slots, in the types of
`protocol/radio`.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from transport.model.state import INPUTS, PER_UAV, REPORTED, REPORTS
from transport.protocol.radio.channel_settings_and_state import ChannelParameters
from transport.protocol.radio.propagation import Propagation, milliwatts, noise_mw, ratio
from transport.protocol.radio.send_times import SendTimes
from transport.protocol.radio.slot_length import fewest_periods, frame_lengths, occupied_ns
from transport.protocol.radio.standards_80211 import STANDARDS
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.codec import encoded_length
from transport.protocol.wire.messages import Plan
from transport.protocol.wire.names import agent_name

NS_PER_S = 1e9
_FREE_SPACE_1M_DB = {"802.11a": 46.7, "802.11b": 40.2}  # 5.15 and 2.44 GHz


def channel_parameters(section: RadioSection, seed: int) -> ChannelParameters:
    """Return the settings of the channel."""
    standard = STANDARDS[section.standard]
    return ChannelParameters(
        standard=standard,
        rate_mbps=section.rate_mbps,
        unicast=section.delivery == "unicast",
        queue_length=section.queue_length,
        attempts=section.attempts,
        noise_mw=noise_mw(standard.bandwidth_hz, section.noise_figure_db),
        sensitivity_mw=milliwatts(section.sensitivity_dbm),
        carrier_sense_mw=milliwatts(section.carrier_sense_dbm),
        preamble_ratio=ratio(section.capture_db),
        seed=seed,
    )


def propagation_of(section: RadioSection, seed: int) -> Propagation:
    """Return the path loss."""
    given_db = section.path_loss_1m_db
    return Propagation(
        power_mw=section.power_mw,
        exponent=section.path_loss_exponent,
        reference_loss_db=_FREE_SPACE_1M_DB[section.standard] if given_db is None else given_db,
        shadowing_db=section.shadowing_db,
        seed=seed,
    )


@dataclass(frozen=True, slots=True)
class PlanShape:
    """Numbers of a plan, by which its length on the air is known."""

    inputs: int = 0  # rows
    corrections: int = 0  # rows
    data: int = 0  # numbers of a controller of the user

    @staticmethod
    def of(setup: TeamRun) -> "PlanShape":
        """Return the shape of the plans of a run before its first plan.

        A class of the user decides with each plan; its least are the inputs of one tick.
        """
        if all(map(is_class, setup.known.controllers)):
            return PlanShape(inputs=1, corrections=0)
        horizon = setup.settings.horizon
        is_corrected = setup.settings.prediction == "closed_loop"
        return PlanShape(inputs=horizon, corrections=horizon if is_corrected else 0)

    def __or__(self, other: "PlanShape") -> "PlanShape":
        """Return the smallest shape that holds the plans of both."""
        return PlanShape(
            inputs=max(self.inputs, other.inputs),
            corrections=max(self.corrections, other.corrections),
            data=max(self.data, other.data),
        )

    def holding(self, plans: Iterable[Plan]) -> "PlanShape":
        """Return the smallest shape that also holds some plans."""
        shape = self
        for plan in plans:
            shape |= PlanShape(len(plan.inputs), len(plan.corrections), plan.data.size)
        return shape


def is_class(controller: str) -> bool:
    """Return whether a controller is a class of the user, "package.module:Class"."""
    return ":" in controller


def send_times(setup: TeamRun, section: RadioSection, shape: PlanShape) -> SendTimes:
    """Return the instants at which the agents send, with slots as long as a plan needs.

    Where not all slots fit into a period, agents take turns. They do not where the section has a
    cycle or no slots, nor where plans are negotiated: each exchange has all slots, however short.
    """
    if section.cycle_ticks is not None:
        return _with_cycle(setup, section, cycle=section.cycle_ticks)
    is_negotiated = setup.settings.negotiation_iterations > 1
    if is_negotiated or section.offsets != "slots":
        return _with_cycle(setup, section, cycle=1)

    # The time that slots may take together does not depend on the cycle.
    spread_ns = _with_cycle(setup, section, cycle=1).spread_ns
    need_ns = slot_need_ns(setup, section, shape)
    cycle = fewest_periods(len(setup.owned), spread_ns, need_ns)
    return _with_cycle(setup, section, cycle=cycle)


def _with_cycle(setup: TeamRun, section: RadioSection, *, cycle: int) -> SendTimes:
    """Return the instants at which the agents send, each once in a cycle of so many ticks."""
    return SendTimes(
        period_ns=setup.rules.period_ns,
        stations=len(setup.owned),
        exchanges=setup.settings.negotiation_iterations,
        offsets=section.offsets,
        cycle=cycle,
        computation_mean_ns=round(section.computation_mean_s * NS_PER_S),
        computation_deviation_ns=round(section.computation_deviation_s * NS_PER_S),
        seed=setup.rules.seed,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SlotLengths:
    """Slots of a run, and what a plan needs of them."""

    plan_bytes: int  # of a plan as long as `plan_length` tells
    plan_s: float  # time that it occupies an idle channel, with its waits and without repetitions
    slot_s: float
    slots: int  # of a tick, or of an exchange of a negotiation
    cycle_ticks: int  # in which each agent has one slot

    @property
    def are_enough(self) -> bool:
        """Whether a plan fits into its slot."""
        return self.plan_s <= self.slot_s

    def text(self) -> str:
        """Return the slots in words; if they are too short, with the consequence and a remedy."""
        ticks = "every tick" if self.cycle_ticks == 1 else f"every {self.cycle_ticks} ticks"
        plan = f"a plan of {self.plan_bytes} bytes takes {1e3 * self.plan_s:.2f} ms"
        slots = f"{self.slots} slots of {1e3 * self.slot_s:.2f} ms, one for each agent {ticks}"
        if self.are_enough:
            return f"{plan}; {slots}"
        remedies = "raise radio.rate_mbps, omit radio.cycle_ticks or negotiate less"
        return f"{plan}, longer than its slot: plans wait for each other and collide; {slots}; {remedies}"


def slot_lengths(setup: TeamRun, shape: PlanShape) -> SlotLengths | None:
    """Return the slots of a run whose plans have a shape; None without a radio, and without slots."""
    section = setup.known.radio
    if section is None or section.offsets != "slots":
        return None
    sends = send_times(setup, section, shape)
    return SlotLengths(
        plan_bytes=plan_length(setup, section, shape),
        plan_s=slot_need_ns(setup, section, shape) / NS_PER_S,
        slot_s=sends.slot_ns / NS_PER_S,
        slots=sends.slots,
        cycle_ticks=sends.cycle,
    )


def slot_need_ns(setup: TeamRun, section: RadioSection, shape: PlanShape) -> int:
    """Return the time that a plan (`plan_length`) occupies an idle channel, ns, without repetitions."""
    receivers = len(setup.owned) - 1 if section.delivery == "unicast" else None
    standard = STANDARDS[section.standard]
    lengths = frame_lengths(plan_length(setup, section, shape))
    return occupied_ns(lengths, standard, section.rate_mbps, receivers=receivers)


def length_on_air(plan: Plan, section: RadioSection) -> int:
    """Return the bytes of a plan as the radio carries it.

    With the first inputs alone the receivers compute the others (docs/radio.md, "Half the bytes").
    """
    if section.inputs == "all":
        return encoded_length(plan)
    return encoded_length(replace(plan, inputs=plan.inputs[:1]))


def plan_length(setup: TeamRun, section: RadioSection, shape: PlanShape) -> int:
    """Return the bytes on the air of a solved plan of the agent with most UAVs at the end of the run.

    Plans of other statuses, and with many notes and reports before them, which count in their sequence,
    take some bytes more.
    """
    owned = max(setup.owned, key=len)
    # MessagePack encodes large integers longer.
    last_agent = setup.agents[-1]
    last_tick = setup.ticks

    reported = REPORTS * REPORTED if setup.sensors.vehicle else PER_UAV
    inputs = INPUTS * len(owned)
    plan = Plan(
        sender=agent_name(last_agent),
        incarnation=0,
        sequence=last_tick,
        tick=last_tick,
        agent=last_agent,
        start_tick=last_tick,
        negotiation=0,
        shared=True,
        uavs=tuple(uav + 1 for uav in owned),
        uav_states=np.zeros((len(owned), reported)),
        inputs=np.zeros((shape.inputs, inputs)),
        corrections=np.zeros((shape.corrections, inputs)),
        status="solved",
        data=np.zeros(shape.data),
    )
    return length_on_air(plan, section)
