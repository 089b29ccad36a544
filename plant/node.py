"""The plant as a state machine: measures at each tick, integrates to the next.

At tick k it publishes the measurements of x_k. Once the inputs of [t_k, t_{k+1}) are decided it
integrates that
interval: with actuation "immediate" from the plans of tick k, with "next_tick" from those of k - 1,
so that plant and agents compute at the same time.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.hover import motor_off_state, no_inputs, released_state
from transport.plant.actuators import INNER_STEP_S, MOTOR_OFF, ActuatorSchedule, Motors, inner_loop
from transport.plant.engines import UNKNOWN_ERROR, Engine
from transport.plant.environment import Environment, Sensors
from transport.protocol.admission.participant import Participant
from transport.protocol.scenario.faults import OF_UAVS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import (
    ActualInputs,
    Measurement,
    Message,
    PlantState,
    Target,
    Tick,
)
from transport.protocol.wire.names import PLANT


class PlantNode(Participant):
    """Plant of one run."""

    wake_ns = None

    def __init__(self, setup: Setup, incarnation: int = 0) -> None:
        section = setup.scenario.plant
        super().__init__(setup, PLANT, incarnation, after=int(setup.scenario.clock.next_tick))
        self.environment = Environment(setup)
        self.engine = Engine(setup, self.environment.system)
        self._period_s = setup.settings.sampling_period_s
        # Parts of a period with own inputs, and integration steps of each.
        self._parts = (
            1
            if setup.settings.inputs == "moments"
            else math.ceil(self._period_s / INNER_STEP_S - 1e-9)
        )
        self._inner_loop = inner_loop(setup, self._period_s / self._parts)
        self._steps = math.ceil(self._period_s / self._parts / section.step_s - 1e-9)
        self._path, _ = setup.maneuver.path(
            self._period_s * np.arange(setup.ticks + 1, dtype=np.float64)
        )
        self._schedule = ActuatorSchedule(setup.hover.u, setup.fail_safe, setup.settings)
        self._faults = deque(
            fault for fault in setup.faults if fault.do in OF_UAVS
        )  # still to come
        self._motors = Motors(
            section.motors, setup.hover.u, any(fault.do == "degrade" for fault in self._faults)
        )
        self._off: set[int] = set()  # UAVs without motors, 0-based
        self._released: set[int] = set()  # of these
        self._x: Array = setup.initial_state()
        self._u: Array = setup.hover.u.copy()  # in force until now
        self._sensors = Sensors(setup) if setup.sensors.vehicle else None
        self._acted: tuple[Array, Array | None] = (
            self._u,
            None,
        )  # actual inputs and forces until now
        self._tick = 0  # self._x is the state at this tick
        self._measured_tick = -1
        self._pending: deque[Tick] = deque()  # open, waiting for the interval before
        self._diverged = False

    def poll(self, now_ns: int) -> Sequence[Message]:  # noqa: ARG002
        """Return nothing: the plant acts on messages only."""
        return ()

    def _take(self, message: Message, now_ns: int) -> None:  # noqa: ARG002
        if isinstance(message, Tick):
            self._pending.append(message)

    def _head(self, target: Target) -> None:
        """Take in a target: the path and the fail-safe before its tick stay as they were, bit for bit."""
        instants = np.arange(target.tick, len(self._path), dtype=np.float64)
        self._path[target.tick :], _ = self._setup.maneuver.path(self._period_s * instants)
        self._schedule.fail_safe = self._setup.fail_safe.of_team(self._off, self._released)

    def _work(self, now_ns: int) -> list[Message]:
        """Measure and integrate in turn as far as the messages received allow."""
        out: list[Message] = []
        while not self._diverged:
            tick = self._pending[0] if self._pending else None
            if tick and tick.tick == self._tick and tick.roster <= self._membership.version:
                out += self._measure(self._pending.popleft())
            elif self._can_integrate():
                out += self._integrate(now_ns)
            else:
                break
        return out

    def _can_integrate(self) -> bool:
        """Return whether the inputs from t_k on are decided.

        Tick k is measured, and its plans have been received.
        """
        k = self._tick
        if self._measured_tick != k:
            return False
        decisive = k - self._after
        if decisive < 0 or not self._waits:
            return True
        senders = self._membership.took_part(decisive)
        # The next tick names the agents that the clock waited for; before it comes, wait for all.
        if self._pending and self._pending[0].tick == decisive + 1:
            senders &= set(self._pending[0].answered)
        return senders <= self._arrived.get(decisive, set())

    def _measure(self, tick: Tick) -> list[Message]:
        self._measured_tick = tick.tick
        self._fail_uavs(tick.tick)
        if self._sensors is not None:
            self._sensors.observe(self.environment.model, self._x, *self._acted)
        return [self._measurement(tick, agent) for agent in sorted(self._membership.incarnations)]

    def _measurement(self, tick: Tick, agent: int) -> Measurement:
        owned = list(self._setup.owned[agent - 1])
        if self._sensors is not None:
            payload, uav_states = np.zeros(0), self._sensors.measured(tick.tick, owned)
        else:
            x = self.environment.measured(tick.tick, agent, self._x)
            payload, uav_states = x[: state.PAYLOAD], state.StateView(x).uavs[owned]
        return self._out.stamp(
            Measurement,
            tick=tick.tick,
            agent=agent,
            answered=tick.answered,
            shared=tick.shared,
            roster=tick.roster,
            payload=payload,
            uavs=tuple(i + 1 for i in owned),
            uav_states=uav_states,
            inputs=self._u.reshape(-1, state.INPUTS)[owned],
        )

    def _fail_uavs(self, tick: int) -> None:
        """Apply the scenario's failures of UAVs due at a tick, before it is measured."""
        while self._faults and self._faults[0].tick <= tick:
            fault = self._faults.popleft()
            uav = fault.uav
            if fault.do == "degrade":
                if uav not in self._off:
                    self._motors.degrade(uav, fault.efficiency)
                continue
            self._off.add(uav)
            self._motors.degrade(uav, 0.0)
            self._x = (
                released_state(self._x, uav)
                if fault.do == "release"
                else motor_off_state(self._x, uav)
            )
            if fault.do == "release":
                self._released.add(uav)
                self.environment.release(uav)
            self.engine.restart(self._x, self.environment.system)
            self._schedule.fail_safe = self._setup.fail_safe.of_team(self._off, self._released)
            if self._inner_loop is not None:
                self._inner_loop.reset(self._x)

    def _integrate(self, now_ns: int) -> list[Message]:
        k, x = self._tick, self._x
        for plan in self._plans.take(k, now_ns)[0]:
            self._schedule.add(plan)
        u, sources = self._schedule.inputs(k, x, self._u)
        if self._off:
            u = no_inputs(u, self._off)
            sources = tuple(
                MOTOR_OFF if i in self._off else source for i, source in enumerate(sources)
            )
        forces = self.environment.forces(k, x)
        end, error, mean = x, UNKNOWN_ERROR, np.zeros_like(u)
        tensions = np.full(len(self.engine.tensions), np.inf)
        part_s = self._period_s / self._parts
        for _ in range(self._parts):
            command = u
            if self._inner_loop is not None:
                rates = u.reshape(-1, state.INPUTS)
                command = self._inner_loop.moments(rates, end).reshape(-1)
            for actual, duration_s in self._motors.inputs(command, part_s, self._steps):
                end, local_error = self.engine.advance(actual, forces, duration_s)
                error, mean = max(local_error, error), mean + duration_s / self._period_s * actual
                self._acted = actual, forces
                if len(tensions):
                    tensions = np.minimum(tensions, self.engine.tensions)
        reason = (
            self.engine.failure
            or (self._inner_loop and self._inner_loop.failure)
            or self._divergence(k + 1, end)
        )
        self._diverged = bool(reason)
        self._x, self._u, self._tick = end, u, k + 1
        self._arrived = {
            tick: agents for tick, agents in self._arrived.items() if tick > k - self._after
        }
        known = error if np.isfinite(end).all() else UNKNOWN_ERROR
        recorded: list[Message] = [
            self._out.stamp(
                PlantState, tick=k, x=x, u=u, plan_ticks=sources, local_error=known, diverged=reason
            )
        ]
        if not self._motors.ideal or self._inner_loop is not None or len(tensions):
            uavs, inputs = tuple(range(1, len(sources) + 1)), mean.reshape(-1, state.INPUTS)
            cables = uavs[: len(tensions)]
            recorded.append(
                self._out.stamp(
                    ActualInputs, tick=k, uavs=uavs, inputs=inputs, cables=cables, tensions=tensions
                )
            )
        return recorded

    def _divergence(self, tick: int, x: Array) -> str:
        """Return why the run has diverged, empty if it has not."""
        if not np.isfinite(x).all():
            return "the state is no longer finite"
        limits = self._setup.scenario.plant
        view = state.StateView(x)
        attitudes = np.degrees(np.abs(np.vstack([view.Theta0[None], view.Theta])[:, :2]))
        worst = np.unravel_index(int(np.argmax(attitudes)), attitudes.shape)
        if attitudes[worst] > limits.max_attitude_deg:
            body, angle = (
                "payload" if worst[0] == 0 else f"UAV{worst[0]}",
                ("roll", "pitch")[worst[1]],
            )
            return f"{body} {angle} of {attitudes[worst]:.0f} deg exceeds {limits.max_attitude_deg:g} deg"
        error = float(np.linalg.norm(view.r0_I - self._path[tick]))
        if error > limits.max_error_m:
            return f"payload position error of {error:.1f} m exceeds {limits.max_error_m:g} m"
        return ""
