"""The process of one UAV as a state machine, between its agent and its autopilot.

    SILENT    the autopilot has not been heard                --its sign of life--> CHECKING
    CHECKING  its parameters, estimate, place, battery        --all fit, armed--> READY
    READY     it hovers by itself, or could from its stand     --tick 0--> FLYING
    FLYING    measures at each tick, and obeys its agent      --end of the run, or off its rod--> RELEASED
    RELEASED  the autopilot holds its place or lands, by itself

A process that starts while the team flies goes to FLYING as soon as it hears its autopilot, whose
motors run, and the instants of the ticks. In FLYING the setpoints come

    from the newest plan of the agent that has started, while it is fresh;
    else from the law of a UAV alone, by the autopilot's own state of this tick;
    else there is none, and the autopilot levels the UAV by itself after its time-out.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.admission.participant import Participant, Ticking
from transport.protocol.admission.told_changes import ToldChanges, changes_in, rests_at
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import (
    LinkChange,
    Measurement,
    Message,
    Plan,
    Roster,
    Schedule,
    Target,
    VehicleStatus,
)
from transport.protocol.wire.names import vehicle_name
from transport.vehicle.autopilot import Autopilot, AutopilotState
from transport.vehicle.checks_before_flight import ChecksBeforeFlight
from transport.vehicle.law_by_autopilot_state import OwnLaw
from transport.vehicle.measurements_at_ticks import TickMeasurements
from transport.vehicle.plan_in_force import BEFORE_ANY_PLAN, NONE, OWN_LAW, Plans

_TURN_NS = 20_000_000  # time between two turns before tick 0, ns of wall time
_TELL_NS = 200_000_000  # time between two statuses there and after the flight, ns of wall time
_NO_PLACE = np.zeros(3)


class VehiclePhase(Enum):
    """Phase of a vehicle, as the table above has them."""

    SILENT = "silent"
    CHECKING = "checking"
    READY = "ready"
    FLYING = "flying"
    RELEASED = "released"


@dataclass(frozen=True, slots=True, kw_only=True)
class Conduct:
    """How a vehicle flies.

    With `stands` the UAV stands until tick 0: it is armed by this process, and given the thrust of
    hover. Otherwise a person arms it, and it hovers by itself.
    """

    section: VehiclesSection
    stands: bool = False


class VehicleNode(Participant):
    """The process of one UAV, 1-based, which is that of the agent with the same number.

    Args:
        setup: The run.
        uav: Its number.
        autopilot: Its autopilot.
        conduct: How it flies.
        incarnation: Number of this start.
        wall_offset_ns: The common clock less the steady clock of this process, ns.

    Attributes:
        phase: Its phase.
    """

    def __init__(
        self,
        setup: TeamRun,
        uav: int,
        autopilot: Autopilot,
        conduct: Conduct,
        incarnation: int = 0,
        wall_offset_ns: int = 0,
    ) -> None:
        self._uav = uav
        self._autopilot = autopilot
        self._stands = conduct.stands
        self._vehicles = conduct.section
        self._wall_offset_ns = wall_offset_ns
        self._period_s = setup.settings.sampling_period_s
        self._own = OwnLaw(setup, uav - 1)
        fail_safe = setup.whole_team().law.fail_safe
        self._plans_in_force = Plans(fail_safe.played(setup.settings.horizon, self._period_s))
        self._hover: Array = setup.hover.u[state.input_slice(uav - 1)]
        weight_N = float(self._hover[0])
        self._checks = ChecksBeforeFlight(
            self._vehicles, autopilot, weight_N, stands=conduct.stands
        )
        self._measurements = TickMeasurements(self._vehicles, setup.rules.clock.speed)
        self._setup = setup
        super().__init__(setup.rules, vehicle_name(uav), incarnation, after=1)

        self.phase = VehiclePhase.SILENT
        self._ticking: Ticking | None = None
        self._schedule_ns = 0  # the start that it follows, ns since 1970
        self._told = ToldChanges()
        # Newest `Schedule.sent_ns`, by the coordinator's clock, and its arrival, by the common clock, ns.
        self._heard: tuple[int, int] = 0, 0
        self._wakes_ns = 0  # when its next turn is
        self._tells_ns = 0  # when its next status is, outside of FLYING
        self._setpoint = 0  # number of the next one since tick 0
        self._inputs = self._hover  # of the last setpoint, (4,), N and rad/s
        self._applied: list[Array] = []  # inputs of the setpoints since the last tick
        # Of the law alone at this tick; None: a plan is fresh.
        self._own_inputs: Array | None = None
        self._source = BEFORE_ANY_PLAN
        self._answered_tick = -1  # newest plan whose first setpoint has been sent
        # From a usable plan to its first setpoint, since the last status; -1: none.
        self._latency_s = -1.0
        self._late_s = 0.0  # largest lateness of a setpoint since the last status
        self._problem = ""  # why the UAV may not fly, or what is wrong in flight

    @property
    def wake_ns(self) -> int:
        """Time of its next turn, ns."""
        return self._wakes_ns

    def warm_up(self) -> None:
        """Prepare, so that no tick takes longer than the others."""
        self._own.warm_up()

    # What comes

    def _handle(self, message: Message, now_ns: int) -> None:
        if isinstance(message, Target | LinkChange):
            self._told.add(message)
        super()._handle(message, now_ns)
        if isinstance(message, Roster) and self._uav in message.released:
            self._let_go(is_in_order=True)

    def _follow_target(self, target: Target) -> None:
        self._setup = self._setup.led_to(target)
        self._own.follow(self._setup)

    def _take(self, message: Message, now_ns: int) -> None:
        match message:
            case Schedule():
                self._heard = message.sent_ns, now_ns + self._wall_offset_ns
                self._told.note(message, now_ns)
                self._follow_schedule(message.start_ns)
            case VehicleStatus():
                # Where the coordinator is gone, another vehicle tells the same instants and changes.
                self._told.note(message, now_ns)
                self._follow_schedule(message.start_ns)
                for change in changes_in(message):
                    with suppress(MessageError):  # one after a gap comes again
                        self.check_moment(change)
                        self._handle(change, now_ns)

    def _follow_schedule(self, start_ns: int) -> None:
        """Take the instants of the ticks; the first that are told hold for the whole run."""
        if start_ns and self._ticking is None:
            self._schedule_ns = start_ns
            speed = self._setup.rules.clock.speed
            self._ticking = Ticking.of(
                start_ns, self._setup.rules.period_ns, speed, self._wall_offset_ns
            )
            self._wakes_ns = 0

    def _take_plan(self, plan: Plan, now_ns: int) -> None:
        super()._take_plan(plan, now_ns)
        self._wakes_ns = 0

    # Turns

    def _work(self, now_ns: int) -> Sequence[Message]:
        return self.poll(now_ns) if now_ns >= self._wakes_ns else ()

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Attend to the autopilot; tell, measure and command what is due."""
        self._autopilot.attend(now_ns)
        told = self._autopilot.state()
        if self.phase is VehiclePhase.RELEASED:
            return self._watch(told, now_ns)
        if self._ticking is None or now_ns < self._ticking.due_ns(0):
            return self._prepare(told, now_ns)
        return self._fly(told, self._ticking, now_ns)

    def _end(self) -> Sequence[Message]:
        """Release the autopilot: the run has ended, in order if it is completed or the team has landed."""
        is_completed = self.finished is not None and self.finished.outcome == "completed"
        newest = self._told.targets[-1] if self._told.targets else None
        has_landed = (
            newest is not None and newest.lands and self._tick >= rests_at(newest, self._period_s)
        )
        self._let_go(is_in_order=is_completed or has_landed)
        return ()

    def _let_go(self, *, is_in_order: bool) -> None:
        """Let the autopilot land, or hold its place, by itself."""
        if self.phase is VehiclePhase.RELEASED:
            return
        self.phase = VehiclePhase.RELEASED
        if is_in_order and self._vehicles.at_end == "land":
            self._autopilot.land()
        else:
            self._autopilot.hold()

    def _prepare(self, told: AutopilotState | None, now_ns: int) -> Sequence[Message]:
        """Check the autopilot, and on a stand arm it and give it the thrust of hover."""
        self._problem = self._checks.problem(told)
        self.phase = VehiclePhase.SILENT if told is None else VehiclePhase.CHECKING
        if told is not None and not self._problem:
            if not (told.armed and told.takes_setpoints):
                self._problem = (
                    f"not armed in the mode of setpoints: {told.mode} {told.says}".strip()
                )
            elif self._stands:
                self._autopilot.command(float(self._hover[0]), np.zeros(3), 0.0)
                self._problem = self._checks.rising(told)
            self.phase = VehiclePhase.CHECKING if self._problem else VehiclePhase.READY

        self._wakes_ns = now_ns + _TURN_NS
        if self._ticking is not None:
            self._wakes_ns = min(self._wakes_ns, self._ticking.due_ns(0))
        if now_ns < self._tells_ns:
            return ()
        self._tells_ns = now_ns + _TELL_NS
        if self._stands and told is not None and self.phase is VehiclePhase.CHECKING:
            self._autopilot.arm()
        # The coordinator speaks first, once all processes listen, the recorder too.
        return [self._status(told, 0, -1.0, now_ns)] if self._heard[0] else []

    def _fly(self, told: AutopilotState | None, ticking: Ticking, now_ns: int) -> Sequence[Message]:
        """Measure at a tick that has come, and send a setpoint that is due."""
        self.phase = VehiclePhase.FLYING
        out: list[Message] = []
        tick = ticking.newest(now_ns)  # also after the last one, until the run has an end
        self._schedule_arrived(tick, now_ns)
        if tick > self._tick:
            self._tick = tick
            out += self._open(told, tick, ticking, now_ns)

        if now_ns >= self._setpoint_ns(ticking):
            self._late_s = max(self._late_s, (now_ns - self._setpoint_ns(ticking)) / 1e9)
            self._command(ticking, now_ns)
            # Instants that have passed are left out.
            rate = self._vehicles.setpoint_hz * self._period_s  # setpoints in a tick
            self._setpoint = max(self._setpoint, int(ticking.ticks(now_ns) * rate)) + 1
        self._wakes_ns = min(self._setpoint_ns(ticking), ticking.due_ns(self._tick + 1))
        return out

    def _watch(self, told: AutopilotState | None, now_ns: int) -> Sequence[Message]:
        """Return the status of a UAV that its autopilot flies by itself: RELEASED."""
        self._wakes_ns = now_ns + _TELL_NS
        self._source = NONE
        return [self._status(told, max(self._tick, 0), -1.0, now_ns)]

    def _setpoint_ns(self, ticking: Ticking) -> int:
        """Return the instant of the next setpoint."""
        rate = self._vehicles.setpoint_hz * self._period_s
        return ticking.due_ns(self._setpoint / rate)

    def _schedule_arrived(self, tick: int, now_ns: int) -> None:
        """Take the plans that have come through the link."""
        usable, _ = self._plans.take(tick, now_ns)
        for plan in usable:
            if self._uav in plan.uavs:
                self._plans_in_force.add(plan, now_ns)

    def _open(
        self, told: AutopilotState | None, tick: int, ticking: Ticking, now_ns: int
    ) -> list[Message]:
        """Return the measurement of a tick, if the autopilot has a valid one, and the status."""
        sensed, age_s = self._measurements.at(told, ticking.due_ns(tick))
        self._problem = self._measurements.problem
        if told is not None and not self._problem and not (told.armed and told.takes_setpoints):
            by = "disarmed" if not told.armed else f"mode {told.mode}"
            self._problem = f"its setpoints have no effect: {by}"
        self._own_inputs = None
        out: list[Message] = []
        if sensed is not None:
            applied = np.mean(self._applied or [self._inputs], axis=0)
            self._own.observe(sensed, float(applied[0]), tick)
            is_planned = self._plans_in_force.at(float(tick)) is not None
            if is_planned:
                self._own.rest()
            else:
                self._own_inputs = self._own.inputs(sensed, tick, self._inputs)
            if tick < self._setup.ticks:
                out.append(self._measurement(tick, sensed, applied))
        self._applied = []
        out.append(self._status(told, min(tick, self._setup.ticks - 1), age_s, now_ns))
        self._late_s = 0.0
        self._latency_s = -1.0
        return out

    def _measurement(self, tick: int, sensed: Array, applied: Array) -> Measurement:
        """Return the measurement of a tick for the agent, (15,), with the mean of the setpoints, (4,)."""
        members = tuple(sorted(self._membership.incarnations))
        return self._out.stamp(
            Measurement,
            tick=tick,
            agent=self._uav,
            answered=members,
            shared=members,
            roster=self._membership.version,
            payload=np.zeros(0),
            uavs=(self._uav,),
            uav_states=sensed[None],
            inputs=applied[None],
        )

    def _command(self, ticking: Ticking, now_ns: int) -> None:
        """Send the setpoint of an instant, if there is one."""
        ticks = ticking.ticks(now_ns)
        planned = self._plans_in_force.at(ticks)
        if planned is not None:
            source, inputs = planned
            plan = source.plan
            if plan.tick > self._answered_tick:
                self._answered_tick = plan.tick
                usable_ns = max(source.arrived_ns, ticking.due_ns(plan.start_tick))
                self._latency_s = (now_ns - usable_ns) / 1e9
            self._source = plan.tick
            since_s = (plan.tick - plan.stale) * self._period_s
        elif self._own_inputs is not None:
            inputs = self._own_inputs
            self._source = OWN_LAW
            since_s = self._tick * self._period_s
        else:
            self._source = NONE
            return
        self._inputs = inputs
        self._applied.append(inputs)
        self._autopilot.command(float(inputs[0]), inputs[1:], since_s)

    def _status(
        self, told: AutopilotState | None, tick: int, age_s: float, now_ns: int
    ) -> VehicleStatus:
        """Return the status of the UAV at a tick, from the autopilot's state, `age_s` old (-1: none)."""
        has_place = told is not None and told.sensed is not None
        position = _NO_PLACE
        if told is not None and told.sensed is not None:
            position = told.sensed[state.POSITION] + self._measurements.shift_I
        return self._out.stamp(
            VehicleStatus,
            tick=tick,
            uav=self._uav,
            phase=self.phase.value,
            problem=self._problem[:1000],
            armed=told is not None and told.armed,
            mode="" if told is None else told.mode,
            battery=-1.0 if told is None else told.battery,
            healthy=has_place and told is not None and told.is_healthy,
            position=position,
            age_s=age_s,
            plan_tick=self._source,
            latency_s=self._latency_s,
            late_s=self._late_s,
            roster=self._membership.version,
            heard_ns=self._heard[0],
            heard_at_ns=self._heard[1],
            sent_ns=now_ns + self._wall_offset_ns,
            start_ns=self._schedule_ns,
            **self._told.counts,
            changes=self._told.lacking(now_ns),
        )
