"""Numbers of the communication in a summary: plans, deadlines, rejections, and times of ticks."""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from transport.analysis.numbers_for_json import percentiles
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages

_NS_PER_MS = 1e6
_TOTAL = messages.STAGES.index("total")  # time of a step in a report
# Agent, 1-based, and its incarnation.
_Member = tuple[int, int]


def rest_of_tick_ms(setup: Setup, log: RunLog) -> dict[int, float]:
    """Return the time of each tick without its slowest agent's step, by tick, ms.

    It runs from the recorder's receiving tick k to its receiving tick k + 1, minus the slowest step
    of tick k: message transport, coding, the work of plant and coordinator, and waiting for a
    processor. 0 where the recorder received the ticks closer together than the step was long: it may read
    a queue. Empty for a paced run (speed > 0), whose ticks wait for the clock.
    """
    if setup.scenario.clock.speed > 0.0:
        return {}

    slowest_ms: dict[int, float] = {}
    for report in log.of(messages.StepReport):
        step_ms = float(report.times_ms[_TOTAL])
        slowest_ms[report.tick] = max(step_ms, slowest_ms.get(report.tick, 0.0))

    received_ns = log.received_ns(messages.Tick)
    rest_ms: dict[int, float] = {}
    for tick, opened_ns in received_ns.items():
        next_ns = received_ns.get(tick + 1)
        if next_ns is None or tick not in slowest_ms:
            continue
        tick_ms = (next_ns - opened_ns) / _NS_PER_MS
        rest_ms[tick] = max(0.0, tick_ms - slowest_ms[tick])
    return rest_ms


def deadline(setup: Setup, log: RunLog) -> dict[str, Any]:
    """Return how many plans missed their deadline, and how late ticks opened.

    There are none in lockstep. A plan of tick k is due when tick k + 1 opens, so the last recorded tick
    has none due. With `clock.on_overrun` hold, ticks wait for all plans: `plans` and `missed` then are
    numbers of ticks, and a tick has missed its deadline that opened late because of a plan. `worst_ms`
    is None in lockstep, and where a plan was missed but none of those missed was received.
    """
    if setup.scenario.clock.mode != "realtime":
        return {
            "plans": 0,
            "missed": 0,
            "share": None,
            "worst_ms": None,
            "tick_late_ms": percentiles([]),
        }

    ticks = {tick.tick: tick for tick in log.of(messages.Tick)}
    pairs = [(ticks[k], ticks[k + 1]) for k in sorted(ticks) if k + 1 in ticks]
    if setup.scenario.clock.on_overrun == "hold":
        due = len(pairs)
        missed = sum(after.overrun_ns > 0 for _, after in pairs)
    else:
        due = sum(len(tick.members) for tick, _ in pairs)
        missed = sum(len(set(tick.members) - set(after.answered)) for tick, after in pairs)

    worst_ms = max((tick.overrun_ns / _NS_PER_MS for tick in ticks.values()), default=None)
    if missed > 0 and worst_ms == 0.0:
        worst_ms = None  # by how much is unknown, not 0
    return {
        "plans": due,
        "missed": missed,
        "share": missed / due if due else None,
        "worst_ms": worst_ms,
        "tick_late_ms": percentiles(tick.late_ns / _NS_PER_MS for tick in ticks.values()),
    }


def links_of_plant(log: RunLog, reports: Sequence[messages.StepReport]) -> dict[str, Any]:
    """Return numbers of the measurements to the agents and of the commands, their plans, to the plant."""
    plans = [plan for plan in log.of(messages.Plan) if not plan.negotiation]
    return {
        "measurements": {
            "sent": sum(1 for _ in log.of(messages.Measurement)),
            "lost": sum(report.measurements_lost for report in reports),
        },
        "commands": {
            "sent": len(plans),
            "lost": sum(state.plans_lost for state in log.of(messages.PlantState)),
        },
    }


def plans_between_agents(
    setup: Setup, log: RunLog, reports: Sequence[messages.StepReport], *, replaced: int
) -> dict[str, int]:
    """Return numbers of the plans between agents.

    A shared one is sent to every other agent that takes a step able to use it. `replaced` were not
    put on the air, as newer ones had their slots. Plans neither delivered, lost nor replaced were in
    transit when the run, or their receiver, ended. `rejected` counts refused messages of any kind.
    """
    plans = [plan for plan in log.of(messages.Plan) if not plan.negotiation]
    shared = [plan for plan in plans if plan.shared]
    sent = _sent(shared, _usable_ticks(setup, log, reports))
    delivered = sum(report.delivered for report in reports)
    lost = sum(report.lost for report in reports)
    # A restarted receiver counts plans again that its predecessor had counted: then more can be reported
    # than were sent, and nothing is known to be in transit.
    in_transit = max(0, sent - delivered - lost - replaced)

    return {
        "planned": len(plans),
        "shared": len(shared),
        "sent": sent,
        "delivered": delivered,
        "lost": lost,
        "in_transit": in_transit,
        "late": sum(report.late for report in reports),
        "rejected": sum(notice.count for notice in log.of(messages.Rejected)),
    }


def _usable_ticks(
    setup: Setup, log: RunLog, reports: Iterable[messages.StepReport]
) -> dict[_Member, Collection[int]]:
    """Return the ticks whose plans each member of the team could use."""
    steps: dict[_Member, set[int]] = {}
    for report in reports:
        member = report.agent, report.incarnation
        steps.setdefault(member, set()).add(report.tick)

    # In lockstep a step uses the plans of the tick before.
    if setup.scenario.clock.mode != "realtime":
        return {member: {tick - 1 for tick in taken} for member, taken in steps.items()}

    # In real time steps are skipped: the next step uses all plans received meanwhile, also of its
    # own tick.
    joined = _joined(log)
    usable: dict[_Member, Collection[int]] = {}
    for member, taken in steps.items():
        first = joined.get(member, min(taken))
        usable[member] = range(first, max(taken) + 1)
    return usable


def _joined(log: RunLog) -> dict[_Member, int]:
    """Return the first tick on the roster of each member of the team."""
    ticks: dict[_Member, int] = {}
    for roster in log.of(messages.Roster):
        for member in zip(roster.agents, roster.incarnations, strict=True):
            ticks.setdefault(member, roster.tick)
    return ticks


def _sent(shared: Iterable[messages.Plan], usable: dict[_Member, Collection[int]]) -> int:
    """Return the number of shared plans, one for each other agent that could use it."""
    sent = 0
    for plan in shared:
        for (receiver, _), ticks in usable.items():
            if receiver != plan.agent and plan.tick in ticks:
                sent += 1
    return sent


def rejections(log: RunLog) -> list[dict[str, Any]]:
    """Return rejected messages by receiver, sender and reason, largest count first."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for notice in log.of(messages.Rejected):
        counts[notice.sender, notice.offender, notice.reason] += notice.count

    largest_first = sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
    return [
        {"by": receiver, "sender": sender, "reason": reason, "count": count}
        for (receiver, sender, reason), count in largest_first
    ]
