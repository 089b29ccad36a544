"""Sampling clocks: when a tick opens, and which answers to it are late."""

from collections.abc import Collection
from collections.abc import Set as AbstractSet

from transport.protocol.scenario.sections.lockstep_and_realtime_section import ClockSection
from transport.protocol.wire.messages import Plan
from transport.protocol.wire.names import agent_names

# A process that wakes up so much later than planned was frozen, or had no processor to run on.
_AWAY_NS = 200_000_000


class Clock:
    """Sampling clock of a run.

    Ticks are due relative to the first one, so that delays do not add up. In lockstep the clock
    waits for all answers, and at a speed above 0 until the next tick is due. In real time it opens
    ticks at their deadlines; `clock.on_overrun` says what happens when plans miss them.

    Times are ns of a steady clock; `missing` are the agents on the roster that have not answered
    the open tick.

    Attributes:
        is_realtime: Whether ticks open at their deadlines.
    """

    def __init__(self, settings: ClockSection, period_ns: int) -> None:
        self._settings = settings
        self._period_ns = period_ns
        self._barrier_ns = round(self._settings.barrier_timeout_s * 1e9)
        self._hold_ns = round(self._settings.join_timeout_s * 1e9)
        self._holds = self._settings.on_overrun == "hold"
        self.is_realtime = self._settings.mode == "realtime"

        # Start of the barrier timeout, or of the wait for agents that faults bring back.
        self._waiting_since_ns = 0
        # When the plant answered, or was first asked for the next interval.
        self._plant_ns = 0
        self._start_ns = 0  # instant of tick 0
        self._is_told = False  # whether others follow it as well
        self._owed_since_ns: dict[int, int] = {}  # by agent: since when it owes an answer
        self._overrun_ns = 0  # largest overrun of a plan since the last tick
        self._overruns = 0  # missed deadlines
        self._called_ns = 0  # when the coordinator last handled something
        self._excused_tick = -1  # newest tick at which the coordinator had stood still

    def begin(self, start_ns: int) -> None:
        """Set the instant of tick 0, which the vehicles have been told."""
        self._start_ns = start_ns
        self._is_told = True

    def restart(self, now_ns: int) -> None:
        """Begin the barrier timeout, or the wait for agents that return, from now on."""
        self._waiting_since_ns = now_ns

    def note_plant(self, now_ns: int) -> None:
        """Note that the plant has answered, or is asked for the next interval and owes no other."""
        self._plant_ns = now_ns

    def newest(self, now_ns: int) -> int:
        """Return the newest tick that is due; -1 before the first."""
        passed_ns = (now_ns - self._start_ns) * self._settings.speed
        return max(int(passed_ns // self._period_ns), -1)

    def due_ns(self, tick: int) -> int:
        """Return the earliest time at which a tick may open."""
        speed = self._settings.speed
        if speed == 0.0:
            return 0
        return self._start_ns + round(tick * self._period_ns / speed)

    @property
    def expires_ns(self) -> int:
        """End of the barrier timeout."""
        return self._waiting_since_ns + self._barrier_ns

    @property
    def hold_ends_ns(self) -> int:
        """End of the wait for agents that the scenario's faults bring back at a tick."""
        return self._waiting_since_ns + self._hold_ns

    def excuse_absence(self, tick: int, wake_ns: int | None, now_ns: int) -> None:
        """Restart all timeouts if the coordinator woke up late: answers may still have to be read.

        Late is measured from the due time `wake_ns`, or from the last call where that was later: a
        coordinator that is busy with a queue of answers was not away.
        At most once while `tick` is open: a process that is always late must still notice lost agents.
        """
        called_ns = self._called_ns
        self._called_ns = now_ns
        if wake_ns is None or self._excused_tick == tick:
            return
        if now_ns <= max(wake_ns, called_ns) + _AWAY_NS:
            return

        self._excused_tick = tick
        self._waiting_since_ns = now_ns
        self._plant_ns = now_ns
        self._owed_since_ns = dict.fromkeys(self._owed_since_ns, now_ns)

    def open(
        self, tick: int, members: Collection[int], joined: Collection[int], now_ns: int
    ) -> None:
        """Note that a tick is opened for the roster, some agents of which have just joined."""
        if tick == 0 and not self._is_told:
            self._start_ns = now_ns
        if self._holds:
            late_ns, _ = self.lateness_ns(tick, now_ns)
            self._start_ns += late_ns  # all later deadlines move by the wait
        self._waiting_since_ns = now_ns
        self._overrun_ns = 0

        for agent in joined:
            self._owed_since_ns.pop(agent, None)
        for agent in members:
            self._owed_since_ns.setdefault(agent, now_ns)

    def answer(self, plan: Plan, tick: int, now_ns: int) -> None:
        """Note an agent's plan while a tick is open."""
        if plan.tick == tick:
            self._owed_since_ns.pop(plan.agent, None)
        else:
            # A late plan: its agent still owes one for the open tick, but is slow, not silent.
            self._owed_since_ns[plan.agent] = now_ns

        # Not used in lockstep, where a tick may be due at 0.
        deadline_ns = self.due_ns(plan.tick + 1)
        self._overrun_ns = max(self._overrun_ns, now_ns - deadline_ns)

    def lateness_ns(self, tick: int, now_ns: int) -> tuple[int, int]:
        """Return the delay of the opening of a tick, and the largest overrun of a plan before it.

        Both are 0 in lockstep, where messages do not depend on wall-clock time.
        """
        if not self.is_realtime:
            return 0, 0
        late_ns = max(0, now_ns - self.due_ns(tick)) if tick > 0 else 0
        return late_ns, self._overrun_ns

    def silent(
        self, members: AbstractSet[int], missing: AbstractSet[int], now_ns: int
    ) -> AbstractSet[int]:
        """Return the agents that have owed an answer for the barrier timeout."""
        if not self.is_realtime:
            return missing if now_ns >= self.expires_ns else set()
        return {
            agent
            for agent in members
            if now_ns >= self._owed_since_ns.get(agent, now_ns) + self._barrier_ns
        }

    def plant_is_silent(self, now_ns: int) -> bool:
        """Return whether the plant has owed an answer for the barrier timeout.

        Never in lockstep, where the agents wait for it, too.
        """
        return self.is_realtime and now_ns >= self._plant_ns + self._barrier_ns

    def is_time_to_close(
        self, tick: int, missing: AbstractSet[int], now_ns: int, *, last: bool
    ) -> bool:
        """Return whether the open tick may be closed.

        In lockstep the last tick closes with its last answer.
        """
        is_due = now_ns >= self.due_ns(tick + 1) or (last and not self.is_realtime)
        return is_due and not self.waits_for(missing)

    def judge_overruns(self, tick: int, missing: AbstractSet[int], now_ns: int) -> str:
        """Count the deadlines missed in a tick that closes; return why they end the run, or ""."""
        self._overruns += len(missing)
        settings = self._settings
        if settings.on_overrun != "abort" or not self.is_realtime:
            return ""

        if self._overruns > settings.overrun_limit:
            t_s = (tick + 1) * self._period_ns / 1e9
            missed = f"{agent_names(missing)} missed the deadline of tick {tick} at t = {t_s:.2f} s"
            counts = f"{self._overruns} missed in total, {settings.overrun_limit} allowed"
            return f"{missed}: {counts}"

        lateness_s = {
            f"tick {tick + 1}": (now_ns - self.due_ns(tick + 1)) / 1e9,
            f"a plan before tick {tick + 1}": self._overrun_ns / 1e9,
        }
        latest = max(lateness_s, key=lateness_s.__getitem__)
        limit_s = settings.overrun_limit_s
        if limit_s is not None and lateness_s[latest] > limit_s:
            return f"{latest} was {lateness_s[latest]:.3f} s late, {limit_s:g} s allowed"
        return ""

    def waits_for(self, missing: AbstractSet[int]) -> bool:
        """Return whether the open tick waits for answers."""
        return bool(missing) and (not self.is_realtime or self._holds)
