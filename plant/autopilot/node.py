"""The plant of a run whose simulated UAVs are flown by autopilots.

It plays physics and sensors to them in small steps, at the pace of the run, and publishes no
measurements: those come from the processes of the vehicles, which hear the autopilots. Until
tick 0 the team stands: its state is held, while the autopilots start, arm and raise their thrust. That is at most
in real time until tick 0 is told, whatever the pace of the run: ArduCopter's navigation takes 40 s.
"""

from collections.abc import Sequence
from typing import Protocol

from transport.model.arrays import Array
from transport.plant.motion_over_period import Integrated
from transport.plant.node import PlantNode, PlantPeriod
from transport.plant.plant_run import PlantRun
from transport.protocol.admission.participant import Ticking
from transport.protocol.wire.messages import Message, PlantState, Schedule

# Most steps in one turn, so that messages are read between them.
_MOST_STEPS = 40
_STEPS = 1  # of integration, between two exchanges
# Time between two turns, s of wall time.
_TURN_S = 0.005
_REPEAT_NS = 10**9  # between two words that the run ends, of wall time
# Time by which the physics may be behind the ticks of the run, s of scenario time: what a host that
# was busy for a moment makes up for.
_BEHIND_S = 1.0


class AutopilotBank(Protocol):
    """Autopilots of all UAVs, in lockstep with the physics."""

    step_s: float
    failure: str  # why the run ends; empty while all answer

    def inputs(self) -> Array:
        """Return thrust and moments of the motors, (4 N,), N and N m."""

    def sense(self, time_s: float, sensed: Array) -> None:
        """Let all go on for a step by their sensors at a time since their start, (15 N,)."""


class PlayedPlant(PlantNode):
    """Plant that plays physics to autopilots.

    wall_offset_ns: The common clock less the steady clock of this process, ns.
    """

    def __init__(
        self,
        setup: PlantRun,
        autopilots: AutopilotBank,
        incarnation: int = 0,
        wall_offset_ns: int = 0,
    ) -> None:
        super().__init__(setup, incarnation)
        self._autopilots = autopilots
        self._wall_offset_ns = wall_offset_ns
        self._step_ns = round(autopilots.step_s * 1e9)
        self._steps_per_tick = round(setup.run.settings.sampling_period_s / autopilots.step_s)
        self._speed_of_run = setup.run.rules.clock.speed
        self.wake_ns = 0
        self._begun_ns: int | None = None  # when the first step was played
        self._played = 0  # steps since then
        self._first: int | None = None  # the step of tick 0
        self._ticking: Ticking | None = None
        self._decided: PlantPeriod | None = None  # for the period that is played
        self._until: Integrated | None = None  # within the period
        self._last_word: PlantState | None = None  # that the run ends, with its reason
        self._repeats_ns = 0  # when it is told again

    def _take(self, message: Message, now_ns: int) -> None:
        if isinstance(message, Schedule) and message.start_ns and self._ticking is None:
            self._ticking = Ticking.of(
                message.start_ns,
                self._setup.run.rules.period_ns,
                self._speed_of_run,
                self._wall_offset_ns,
            )
            until_ns = (self._ticking.start_ns - now_ns) * self._speed_of_run
            self._let_go_after(max(round(until_ns / self._step_ns), 0), now_ns)

    def _let_go_after(self, steps: int, now_ns: int) -> None:
        """Let the team go after a number of steps, from now on at the pace of the run."""
        self._first = self._played + steps
        self._begun_ns = now_ns - round(self._played * self._step_ns / self._speed_of_run)

    def _work(self, now_ns: int) -> list[Message]:  # noqa: ARG002
        """Return nothing on a message: this plant acts by its clock."""
        return []

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Play the steps that are due; return what is recorded of periods that end."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
        speed = 1.0 if self._first is None else self._speed_of_run
        due = int((now_ns - self._begun_ns) * speed / self._step_ns)
        behind_s = (due - self._played) * self._autopilots.step_s
        out: list[Message] = []
        if self._first is None:
            # Before tick 0 is told nothing depends on the pace: a host that is slow falls back.
            if behind_s > _BEHIND_S:
                self._begun_ns += round((behind_s - _BEHIND_S) * 1e9)
        elif behind_s > _BEHIND_S and not self._diverged:
            remedy = "lower clock.speed"
            self._autopilots.failure = f"the physics are {behind_s:.1f} s behind: {remedy}"
        for _ in range(min(due - self._played, _MOST_STEPS)):
            if self._diverged:
                break
            out += self._play(now_ns)
            if self._diverged:
                states = [message for message in out if isinstance(message, PlantState)]
                self._last_word = states[-1] if states else None
                self._repeats_ns = now_ns + _REPEAT_NS
        is_behind = due > self._played
        self.wake_ns = now_ns if is_behind else now_ns + round(_TURN_S * 1e9)
        if self._diverged:
            self.wake_ns = now_ns + _REPEAT_NS
            out += self._repeated(now_ns)
        return out

    def _repeated(self, now_ns: int) -> list[Message]:
        """Return once a second that the run ends: a coordinator that was away has not heard it."""
        last = self._last_word
        if last is None or self._ticking is None or now_ns < self._repeats_ns:
            return []
        self._repeats_ns = now_ns + _REPEAT_NS
        tick = min(self._ticking.newest(now_ns), self._setup.run.rules.ticks - 1)
        if tick <= last.tick:
            return []
        return [
            self._out.stamp(
                PlantState,
                tick=tick,
                x=last.x,
                u=last.u,
                plan_ticks=last.plan_ticks,
                local_error=last.local_error,
                diverged=last.diverged,
                plans_lost=0,
            )
        ]

    def _play(self, now_ns: int) -> list[Message]:
        """Play one step; return what is recorded of a period that ends with it."""
        wrench = self._autopilots.inputs()
        free = -1 if self._first is None else self._played - self._first
        out: list[Message] = []
        x, actual = self._x, self._actual
        if free >= 0:
            if free % self._steps_per_tick == 0:
                self._begin_period(free // self._steps_per_tick, now_ns)
            out = self._step(wrench, (free + 1) % self._steps_per_tick == 0)
            x = self._x if self._until is None else self._until.x
            actual = self._actual if self._until is None else self._until.actual
        forces = None if self._decided is None else self._decided.forces
        sensed = self.environment.model.sensed(x, actual, forces=forces)
        self._played += 1
        self._autopilots.sense(self._played * self._autopilots.step_s, sensed)
        return out

    def _begin_period(self, k: int, now_ns: int) -> None:
        """Begin the period of tick k: failures of UAVs, the plans for the record, the wind."""
        self._tick = k
        self._fail_uavs(k)
        self._decided = self._period(now_ns)
        self._until = self._motion.begin(self._x, self._decided.u)

    def _step(self, wrench: Array, is_last: bool) -> list[Message]:
        """Integrate one step under thrust and moments of the motors; conclude a period with its last."""
        if self._decided is None or self._until is None:
            return []
        step_s = self._autopilots.step_s
        forces = self._decided.forces
        self._until = self._motion.part(self._until, wrench, forces, step_s, _STEPS)
        if not is_last and not self._autopilots.failure:
            return []
        end = self._until
        self._until = None
        if self._k >= self._setup.run.rules.ticks:  # after the last tick nothing is recorded
            self._x = end.x
            return []
        return self._conclude(self._decided, end)

    def _failure(self, tick: int, x: Array) -> str:
        """Return why the run ends after a period, empty if it goes on."""
        return self._autopilots.failure or super()._failure(tick, x)
