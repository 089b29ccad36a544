"""Messages of a log that count: those of agents that took part in the tick of the message.

An agent that was stopped may send an outdated plan when it continues; no other process accepts it.
"""

from dataclasses import replace

from protocol.scenario.setup import Setup
from protocol.wire.messages import Plan, Roster, StepReport, Tick
from transport.log.run_log import Recorded, RunLog


def counted(setup: Setup, log: RunLog) -> RunLog:
    """Return a log without plans and reports from incarnations of an agent that were not on the roster.

    In lockstep each tick also names the agents that answered the one before; later answers do not count. Messages whose
    tick or roster is missing count.
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
