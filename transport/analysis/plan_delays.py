"""Delays of the plans that agents used, over the links of the scenario and the radio of the team."""

from collections.abc import Mapping

from transport.log.run_log import RunLog
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.links.link_changes import LinkChanges
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Airtime, LinkChange, StepReport
from transport.protocol.wire.names import agent_name

# Tick and number of an agent that has made a step.
Step = tuple[int, int]


def plan_delays(setup: Setup, log: RunLog) -> dict[Step, dict[int, float]]:
    """Return the delay of the newest plan of each other agent that a step used, s, by step and sender.

    The delay runs from the tick of the plan to its arrival: on the air, if the team has a radio, and
    then over the link, of two copies that of the first. Links repeat their draws by seed and tick, so
    the log need not have them. The time on the actual network, which counts in real time only, is not
    in it. Plans of which the log does not tell that are left out.
    """
    links = _links(setup, log)
    aired = _aired(log)
    known: dict[tuple[int, int, int], float | None] = {}
    delays: dict[Step, dict[int, float]] = {}

    for report in log.of(StepReport):
        used = delays.setdefault((report.tick, report.agent), {})
        for sender, age in zip(report.peers, report.plan_ages, strict=True):
            link = links.get((sender, report.agent))
            if not 0 <= age <= report.tick or link is None:
                continue
            key = sender, report.agent, report.tick - age
            if key not in known:
                air_s = aired.get(key) if setup.scenario.radio is not None else 0.0
                copies_s = link.delays(report.tick - age)
                is_known = air_s is not None and copies_s
                known[key] = (air_s or 0.0) + min(copies_s) if is_known else None
            delay_s = known[key]
            if delay_s is not None:
                used[sender] = delay_s
    return delays


def first_uses(
    setup: Setup, log: RunLog, delays: Mapping[Step, Mapping[int, float]]
) -> dict[int, list[tuple[float, float]]]:
    """Return the time of the first step that used a plan, s, and its delay, s, by receiving agent.

    A plan that is used at several ticks, since newer ones are late or lost, counts once.
    """
    uses: dict[int, list[tuple[float, float]]] = {}
    seen = set[tuple[int, int, int]]()
    for report in sorted(log.of(StepReport), key=lambda report: report.tick):
        time_s = report.tick * setup.settings.sampling_period_s
        used = delays.get((report.tick, report.agent), {})
        for sender, age in zip(report.peers, report.plan_ages, strict=True):
            plan = report.agent, sender, report.tick - age
            if sender in used and plan not in seen:
                seen.add(plan)
                uses.setdefault(report.agent, []).append((time_s, used[sender]))
    return uses


def _links(setup: Setup, log: RunLog) -> dict[tuple[int, int], Link]:
    """Return the links by sender and receiver, with all changes of the run."""
    links = {
        (sender, receiver): setup.rules.link(agent_name(sender), agent_name(receiver))
        for sender in setup.agents
        for receiver in setup.agents
        if sender != receiver
    }
    changes = LinkChanges(links.values())
    for change in sorted(log.of(LinkChange), key=lambda change: change.number):
        changes.apply(change)
    return links


def _aired(log: RunLog) -> dict[tuple[int, int, int], float]:
    """Return when plans came through the air, s after their tick, by sender, receiver and tick."""
    arrivals: dict[tuple[int, int, int], float] = {}
    for airtime in log.of(Airtime):
        frames = zip(
            airtime.agents, airtime.plan_ticks, airtime.exchanges, airtime.arrivals, strict=True
        )
        for sender, tick, exchange, at_s in frames:
            if exchange:  # a proposal of a negotiation
                continue
            for receiver, arrival_s in zip(airtime.receivers, at_s, strict=True):
                if arrival_s >= 0.0:
                    arrivals[sender, receiver, tick] = float(arrival_s)
    return arrivals
