"""Which messages of a log count: those of processes that took part in the tick they are about.

A process that was frozen may still say, once it runs again, what it had begun; nobody believes it by then.
"""

from dataclasses import replace

from protocol.scenario.setup import Setup
from protocol.wire.messages import Plan, Roster, StepReport, Tick
from transport.log.run_log import Recorded, RunLog


def counted(setup: Setup, log: RunLog) -> RunLog:
    """A log without the plans and reports that nobody believed: of starts of an agent that were not on the roster.

    In lockstep the coordinator says who has answered a tick; whoever did not is not heard later, either.

    Args:
        setup: The run.
        log: Its log; what a log that is not whole cannot tell counts.
    """
    rosters = {roster.version: dict(zip(roster.agents, roster.incarnations, strict=True)) for roster in log.of(Roster)}
    ticks = {tick.tick: tick for tick in log.of(Tick)}
    lockstep = setup.scenario.clock.mode == "lockstep"

    def counts(entry: Recorded) -> bool:
        message = entry.message
        if not isinstance(message, Plan | StepReport):
            return True
        tick, after = ticks.get(message.tick), ticks.get(message.tick + 1)
        members = rosters.get(tick.roster) if tick is not None else None
        if members is not None and members.get(message.agent) != message.incarnation:
            return False
        return not lockstep or after is None or message.agent in after.answered

    return replace(log, messages=tuple(filter(counts, log.messages)))
