"""The plant as a state machine: measures at each tick, integrates to the next.

    AT t_k       has the state x_k                      --tick k, and its roster--> MEASURED
    MEASURED     has published the measurements of x_k  --the inputs from t_k on are decided--> AT t_{k+1}
    DIVERGED     has published why it ends              from MEASURED, when x_{k+1} is beyond its limits

The inputs of [t_k, t_{k+1}) are decided by the plans of tick k with actuation "immediate", and by those
of k - 1 with "next_tick", so that plant and agents compute at the same time. Faults of UAVs, sensors and
load act with tick k, before its measurements. UAVs without a usable plan follow the fail-safe, along the
path that the whole team knows (`plant.team_paths`). What happens within a period is `plant.motion_over_period`.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import motor_off_state, no_inputs, released_state
from transport.model.physics.parameters import Payload
from transport.plant.actual_bodies import payload_during
from transport.plant.actuator_schedule import MOTOR_OFF, ActuatorSchedule
from transport.plant.engines import Engine
from transport.plant.motion_over_period import Integrated, PeriodMotion
from transport.plant.plant_run import PlantRun
from transport.plant.solids_in_sight import seen_from
from transport.plant.team_paths import TeamPaths
from transport.plant.vehicle_sensors import Sensors
from transport.plant.wind_and_noise import Environment
from transport.protocol.admission.participant import Participant
from transport.protocol.scenario.faults.faults_by_tick import OF_PLANT, Fault
from transport.protocol.wire.messages import (
    ActualInputs,
    Measurement,
    Message,
    PlantState,
    Target,
    Tick,
)
from transport.protocol.wire.names import PLANT


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantPeriod:
    """What is decided at the beginning of a sampling period.

    Attributes:
        u: Commands over it, (4 N,).
        sources: Source of those of each UAV, as in `PlantState.plan_ticks`.
        forces: External forces, (3 + 3 N,), N; None without wind.
        plans_lost: Plans that are known to be lost since the period before.
    """

    u: Array
    sources: tuple[int, ...]
    forces: Array | None
    plans_lost: int


class PlantNode(Participant):
    """Plant of one run."""

    wake_ns: int | None = None

    def __init__(self, setup: PlantRun, incarnation: int = 0) -> None:
        self._setup = setup
        super().__init__(
            setup.run.rules, PLANT, incarnation, after=int(setup.run.rules.clock.next_tick)
        )
        self.environment = Environment(setup)
        self.engine = Engine(setup, self.environment.system)

        self._motion = PeriodMotion(setup, self.engine)
        self._paths = TeamPaths(setup.run)
        self._tilts = state.tilt_indices(setup.run.system.N)
        self._schedule = ActuatorSchedule(
            setup.run.hover.u, self._paths.fail_safe, setup.run.settings
        )
        own = [fault for fault in setup.run.rules.faults if fault.do in OF_PLANT]
        self._faults = deque(own)  # still to come
        # Newest change of the load while it goes on, and the payload before it.
        self._loading: tuple[Fault, Payload] | None = None
        self._off: set[int] = set()  # UAVs without motors, 0-based
        self._released: set[int] = set()  # of these

        self._k = 0  # the tick of the state; MEASURED while `_tick`, the newest one open, equals it
        self._x: Array = setup.run.initial_state()
        # In force until tick k: commands, actual inputs and external forces.
        self._u: Array = setup.run.hover.u.copy()
        self._actual: Array = self._u
        self._forces: Array | None = None
        self._sensors = Sensors(setup) if setup.run.sensors.vehicle else None
        self._pending: deque[Tick] = deque()  # open, waiting for the interval before
        self._diverged = False

    def warm_up(self) -> None:
        """Prepare, so that no period of the run is slower than the others."""
        self.engine.warm_up(self._setup)
        self._schedule.fail_safe.warm_up()

    def poll(self, now_ns: int) -> Sequence[Message]:  # noqa: ARG002
        """Return nothing: the plant acts on messages only."""
        return ()

    def _take(self, message: Message, now_ns: int) -> None:  # noqa: ARG002
        if isinstance(message, Tick):
            self._pending.append(message)

    def _follow_target(self, target: Target) -> None:
        if self._paths.tell(target, self._k):
            self._renew_fail_safe()

    def _work(self, now_ns: int) -> list[Message]:
        """Measure and integrate in turn as far as the messages received allow."""
        out: list[Message] = []
        while not self._diverged:
            tick = self._pending[0] if self._pending else None
            if tick and tick.tick == self._k and tick.roster <= self._membership.version:
                out += self._begin_tick(self._pending.popleft())
            elif self._can_integrate():
                out += self._integrate(now_ns)
            else:
                break
        return out

    def _can_integrate(self) -> bool:
        """Return whether the inputs from t_k on are decided.

        Tick k is measured, and its plans have been received.
        """
        if self._tick != self._k:
            return False
        decisive = self._k - self._usable_after
        if decisive < 0 or not self._waits:
            return True
        senders = self._membership.took_part(decisive)
        # The next tick names the agents that the clock waited for; before it comes, wait for all.
        if self._pending and self._pending[0].tick == decisive + 1:
            senders &= set(self._pending[0].answered)
        return senders <= self._arrived.get(decisive, set())

    def _begin_tick(self, tick: Tick) -> list[Message]:
        """Apply failures of UAVs; return the measurements, one for each agent on the roster."""
        self._tick = tick.tick
        self._fail_uavs(tick.tick)
        if self._sensors is not None:
            x = self.environment.of_centre(self._x)
            self._sensors.observe(self.environment.model, x, self._actual, self._forces)
        places_I = self._setup.run.positions_I(self._x) if self._setup.hidden else None
        return [
            self._measurement(tick, agent, places_I)
            for agent in sorted(self._membership.incarnations)
        ]

    def _measurement(self, tick: Tick, agent: int, places_I: Array | None) -> Measurement:
        """Return the measurement of an agent, 1-based: UAVs and, unless by sensors, payload.

        With obstacles to see, by the places of all UAVs, (N, 3), m, those that its own see.
        """
        owned = list(self._setup.run.owned[agent - 1])
        missing: tuple[int, ...] = ()
        if self._sensors is not None:
            payload = np.zeros(0)
            uav_states = self._sensors.measured(tick.tick, owned)
            missing = self._sensors.missing(tick.tick, owned)
        else:
            x = self.environment.measured(tick.tick, agent, self._x)
            payload = x[: state.PAYLOAD]
            uav_states = state.uav_blocks(x)[owned]
        seen = {}
        if places_I is not None:
            seen = {"seen": seen_from(places_I[owned], self._setup.hidden)}
        return self._out.stamp(
            Measurement,
            tick=tick.tick,
            agent=agent,
            answered=tick.answered,
            shared=tick.shared,
            roster=tick.roster,
            payload=payload,
            uavs=tuple(uav + 1 for uav in owned),
            uav_states=uav_states,
            inputs=self._u.reshape(-1, state.INPUTS)[owned],
            missing=missing if any(missing) else (),
            **seen,
        )

    def _fail_uavs(self, tick: int) -> None:
        """Apply the scenario's faults of UAVs and load due at a tick, before it is measured."""
        while self._faults and self._faults[0].tick <= tick:
            fault = self._faults.popleft()
            match fault.do:
                case "motor_off":
                    self._switch_off(fault.uav, released=False)
                case "release":
                    self._switch_off(fault.uav, released=True)
                case "degrade":
                    if fault.uav not in self._off:
                        self._motion.motors.degrade(fault.uav, fault.efficiency)
                case "sensors_off":
                    if self._sensors is not None:
                        self._sensors.fail(fault.uav, fault.sensors, fault.until)
                case "load":
                    self._loading = fault, self.environment.system.payload
                case other:
                    raise AssertionError(f"{other} is no fault of the plant (OF_PLANT)")
        self._change_load(tick)

    def _change_load(self, tick: int) -> None:
        """Apply the part of a change of the load that is due at a tick, linear in its duration."""
        if self._loading is None:
            return
        fault, before = self._loading
        last = fault.tick if fault.until is None else fault.until - 1
        share = (tick + 1 - fault.tick) / (last + 1 - fault.tick)
        if tick >= last:
            share, self._loading = 1.0, None
        self.environment.load(payload_during(fault.load, before, share))
        self.engine.restart(self._x, self.environment.system)

    def _switch_off(self, uav: int, *, released: bool) -> None:
        """Switch the motors of a UAV off, 0-based, and take it off its rod if it is released."""
        self._off.add(uav)
        self._motion.motors.degrade(uav, 0.0)
        if released:
            self._x = released_state(self._x, uav)
            self._released.add(uav)
            self.environment.release(uav)
            self._unload(uav)
        else:
            self._x = motor_off_state(self._x, uav)

        # The engine and the fail-safe take the remaining team.
        self.engine.restart(self._x, self.environment.system)
        self._renew_fail_safe()
        if self._motion.inner_loop is not None:
            self._motion.inner_loop.reset(self._x)

    def _unload(self, uav: int) -> None:
        """Take thrust and wind off the bob that stands for a released UAV, 0-based.

        Those of the interval before, on a millionth of a kilogram, are no specific force.
        """
        self._actual = no_inputs(self._actual, {uav})
        if self._forces is not None:
            self._forces = self._forces.copy()
            self._forces.reshape(-1, 3)[1 + uav] = 0.0

    def _renew_fail_safe(self) -> None:
        """Take the fail-safe of the remaining UAVs along the newest shared path."""
        of_all = self._paths.fail_safe
        self._schedule.fail_safe = of_all.of_team(self._off, self._released)

    def _integrate(self, now_ns: int) -> list[Message]:
        """Integrate [t_k, t_{k+1}) and return what is recorded of it."""
        period = self._period(now_ns)
        end = self._motion.over_period(self._x, period.u, period.forces)
        return self._conclude(period, end)

    def _period(self, now_ns: int) -> PlantPeriod:
        """Return what is decided for [t_k, t_{k+1})."""
        plans_lost = self._schedule_arrived(now_ns)
        u, sources = self._commands()
        forces = self.environment.forces(self._k, self._x)
        return PlantPeriod(u=u, sources=sources, forces=forces, plans_lost=plans_lost)

    def _conclude(self, period: PlantPeriod, end: Integrated) -> list[Message]:
        """Go on to the next tick; return what is recorded of the period until it."""
        k = self._k
        x = self._x
        reason = self._failure(k + 1, end.x)

        self._diverged = bool(reason)
        self._k = k + 1
        self._x = end.x
        self._u = period.u
        self._actual = end.actual
        self._forces = period.forces
        oldest = k + 1 - self._usable_after
        self._arrived = {tick: agents for tick, agents in self._arrived.items() if tick >= oldest}
        plant_state = self._out.stamp(
            PlantState,
            tick=k,
            x=x,
            u=period.u,
            plan_ticks=period.sources,
            local_error=end.error,
            diverged=reason,
            plans_lost=period.plans_lost,
        )
        return [plant_state, *self._actual_inputs(k, end)]

    def _schedule_arrived(self, now_ns: int) -> int:
        """Schedule the plans that have become usable; return how many are known to be lost."""
        usable, lost = self._plans.take(self._k, now_ns)
        for plan in usable:
            self._schedule.add(plan)
        if self._paths.hear(usable, self._k, self._membership.since):
            self._renew_fail_safe()
        return lost

    def _commands(self) -> tuple[Array, tuple[int, ...]]:
        """Return the commands over [t_k, t_{k+1}), (4 N,), and the source of those of each UAV."""
        u, sources = self._schedule.inputs(self._k, self._x, self._u)
        if not self._off:
            return u, sources
        without = tuple(
            MOTOR_OFF if uav in self._off else source for uav, source in enumerate(sources)
        )
        return no_inputs(u, self._off), without

    def _actual_inputs(self, k: int, end: Integrated) -> list[Message]:
        """Return the actual inputs of a period if they are not the commands, or with cables."""
        if self._motion.follows_commands and not len(end.tensions):
            return []
        inputs = end.mean.reshape(-1, state.INPUTS)
        uavs = tuple(range(1, len(inputs) + 1))
        return [
            self._out.stamp(
                ActualInputs,
                tick=k,
                uavs=uavs,
                inputs=inputs,
                cables=uavs[: len(end.tensions)],
                tensions=end.tensions,
            )
        ]

    def _failure(self, tick: int, x: Array) -> str:
        """Return why the run ends after a period, empty if it goes on."""
        return self._motion.failure or self._divergence(tick, x)

    def _divergence(self, tick: int, x: Array) -> str:
        """Return why the run has diverged, empty if it has not."""
        if not np.isfinite(x).all():
            return "the state is no longer finite"
        limits = self._setup.section
        tilts = np.degrees(np.abs(x[self._tilts]))
        worst = int(np.argmax(tilts))
        if tilts[worst] > limits.max_attitude_deg:
            uav, axis = divmod(worst, 2)  # roll and pitch of the payload, of UAV 1, ...
            body = "payload" if uav == 0 else f"UAV{uav}"
            size = f"{body} {('roll', 'pitch')[axis]} of {tilts[worst]:.0f} deg"
            return f"{size} exceeds {limits.max_attitude_deg:g} deg"

        distance_m = float(np.linalg.norm(x[state.R0] - self._paths.given_I[tick]))
        if distance_m > limits.max_error_m:
            return f"payload position error of {distance_m:.1f} m exceeds {limits.max_error_m:g} m"
        return ""
