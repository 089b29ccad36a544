"""A run as its report reads it: scenario with all targets, messages that count, and series."""

from dataclasses import dataclass, replace

from transport.analysis.series import Series, series_of
from transport.analysis.targets_in_log import led_as_logged
from transport.log.run_log import Recorded, RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Plan, Roster, StepReport, Tick


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalysedRun:
    """A run with its series, computed once for summary, tables and figures."""

    setup: Setup  # with the targets of the whole run
    log: RunLog
    series: Series

    @classmethod
    def of(cls, setup: Setup, log: RunLog) -> "AnalysedRun":
        """Return a run with the series of the plant states in its log."""
        led = led_as_logged(setup, log)
        return cls(setup=led, log=log, series=series_of(led, log))


def counted(setup: Setup, log: RunLog) -> RunLog:
    """Return a log without the plans and reports that no other process accepts.

    They are those of incarnations of an agent that were not on the roster, such as of one that was
    stopped and continues, and in lockstep those that missed their tick. Messages whose tick or
    roster is missing count.
    """
    rosters = {
        roster.version: dict(zip(roster.agents, roster.incarnations, strict=True))
        for roster in log.of(Roster)
    }
    ticks = {tick.tick: tick for tick in log.of(Tick)}
    lockstep = setup.scenario.clock.mode == "lockstep"

    def counts(entry: Recorded) -> bool:
        message = entry.message
        if not isinstance(message, Plan | StepReport):
            return True

        tick = ticks.get(message.tick)
        members = rosters.get(tick.roster) if tick is not None else None
        if members is not None and members.get(message.agent) != message.incarnation:
            return False

        after = ticks.get(message.tick + 1)
        return not lockstep or after is None or message.agent in after.answered

    return replace(log, messages=tuple(filter(counts, log.messages)))
