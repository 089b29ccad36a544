"""What a log lacks: messages that did not reach the recorder, found by what the others tell of them.

Four signs say that a message is missing, each with the ticks that it may be of:

    numbers   each process numbers its messages: a gap between two of them
    states    the plant has simulated a tick, as later messages tell, and its state is missing
    plans     the plant has followed a plan that is not recorded
    roster    in real time an agent was on the roster for longer after its last plan than is admitted

The last three find messages at the end of a process, which leave no gap.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise

from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages as wire
from transport.protocol.wire.key_expressions import RECORDER
from transport.protocol.wire.messages import Message, Plan
from transport.protocol.wire.names import COORDINATOR

# Ticks between a timeout of the coordinator and the next roster, at most.
_SLACK_TICKS = 3


def missing(log: RunLog, setup: Setup | None) -> str:
    """Return a sentence with the ticks between which messages are missing; empty if none is.

    Every process numbers its messages. Those missing at its end leave no gap: they are known from
    the messages of others, and from the roster if the run is known.
    """
    # Rejections have numbers of their own.
    messages = [
        entry.message for entry in log.messages if not isinstance(entry.message, wire.Rejected)
    ]
    ticks = _ticks_around_gaps(messages)

    last_recorded = max((state.tick for state in log.of(wire.PlantState)), default=-1)
    has_plant = setup is None or setup.scenario.has_plant
    last_simulated = _last_simulated(log, messages) if has_plant else -1
    if last_simulated > last_recorded:
        ticks += [last_recorded + 1, last_simulated]
    ticks += _ticks_of_unrecorded_plans(log)
    if setup is not None:
        ticks += _ticks_of_silent_members(log, setup)

    if not ticks:
        return ""
    return f"some messages of ticks {min(ticks)} to {max(ticks)} did not reach the recorder"


def _ticks_around_gaps(messages: Sequence[Message]) -> list[int]:
    """Return the ticks of the messages before and behind each gap in the numbers of a process."""
    # Ticks by sender and incarnation, then by number; each process begins before number 0.
    ticks: dict[tuple[str, int], dict[int, int]] = {}
    for message in messages:
        if message.sender == RECORDER:  # its own notes cannot get lost
            continue
        process = (message.sender, message.incarnation)
        ticks.setdefault(process, {-1: 0})[message.sequence] = message.tick

    around: list[int] = []
    for tick_of in ticks.values():
        for before, behind in pairwise(sorted(tick_of)):
            if behind > before + 1:
                around += [tick_of[before], tick_of[behind]]
    return around


def _ticks_of_unrecorded_plans(log: RunLog) -> list[int]:
    """Return the first and last tick of plans that the plant followed and the recorder lacks."""
    recorded: dict[int, int] = {}  # newest tick by UAV, 1-based
    for plan in log.of(Plan):
        for uav in plan.uavs:
            recorded[uav] = max(plan.tick, recorded.get(uav, -1))

    followed: dict[int, int] = {}
    for state in log.of(wire.PlantState):
        for uav, tick in enumerate(state.plan_ticks, start=1):
            followed[uav] = max(tick, followed.get(uav, -1))

    ticks: list[int] = []
    for uav, last_followed in followed.items():
        last_recorded = recorded.get(uav, -1)
        if last_followed > last_recorded:
            ticks += [last_recorded + 1, last_followed]
    return ticks


def _ticks_of_silent_members(log: RunLog, setup: Setup) -> list[int]:
    """Return the ticks on the roster of agents after their last plan, if these are too many.

    In real time the coordinator removes a member of which it does not hear within its timeout. The
    plan that it hears then may itself be as old: twice the timeout is allowed.
    """
    clock = setup.scenario.clock
    if clock.mode != "realtime":
        return []

    timeout_s = clock.speed * clock.barrier_timeout_s
    longest = 2.0 * timeout_s / setup.settings.sampling_period_s + _SLACK_TICKS
    member: dict[int, int] = {}
    for opened in log.of(wire.Tick):
        member |= dict.fromkeys(opened.members, opened.tick)
    # Newest tick with a plan, or before the newest return to the roster.
    planned: dict[int, int] = {}
    before: tuple[int, ...] = ()
    for roster in log.of(wire.Roster):
        planned |= {agent: roster.tick - 1 for agent in roster.agents if agent not in before}
        before = roster.agents
    for plan in log.of(Plan):
        planned[plan.agent] = max(plan.tick, planned.get(plan.agent, -1))

    ticks: list[int] = []
    for agent, last_member in member.items():
        last_planned = planned.get(agent, -1)
        if last_member > last_planned + longest:
            ticks += [last_planned + 1, last_member]
    return ticks


def _last_simulated(log: RunLog, messages: Iterable[Message]) -> int:
    """Return the last tick that the plant has simulated, as the other messages tell.

    Returns: -1 for none.
    """
    # The plant measures at a tick after simulating the one before.
    kinds = (wire.Measurement, Plan, wire.StepReport)
    ticks = [message.tick - 1 for message in messages if isinstance(message, kinds)]
    ticks += [
        end.tick
        for end in log.of(wire.Control)
        if end.outcome in ("completed", "failed") and end.sender == COORDINATOR
    ]
    return max(ticks, default=-1)
