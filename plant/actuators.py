"""Actuators of the plant: schedule of the plans, inner loops, and motors, for any engine.

Each UAV follows the newest plan that has started, and a fail-safe once its inputs, counted from the last
solved step, have been played. From commanded
body rates an inner loop makes thrust and moments. Motors round the command's thrust to its steps;
distribute thrust and moments to the four rotors, limit them there, and sum them up again; follow
with a first-order lag, or each rotor with a lag for rising and one for falling thrust; and multiply
what arrives by the efficiency of the UAV's motors. A stage that a scenario does not name is left
out.
"""

import importlib
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear import motor_lag as motors
from transport.model.physics.parameters import System
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.settings import ControllerSettings
from transport.plant.plant_run import PlantRun
from transport.protocol.scenario.sections.plant_sections import MotorsSection, RotorsSection
from transport.protocol.wire.messages import Plan

# Sources of an input that is not from a plan (`PlantState.plan_ticks`).
BEFORE_ANY_PLAN = -1
FAIL_SAFE = -2
MOTOR_OFF = -3
# These start processes, so they are imported by runs with a firmware or autopilots only.
_FIRMWARE = "transport.plant.firmware.betaflight"
_AUTOPILOTS = "transport.plant.autopilot.autopilot_processes"
# Longest time between two evaluations of an inner loop, s.
INNER_STEP_S = 1e-3


class ActuatorSchedule:
    """Inputs of all actuators, tick by tick.

    Hover, (4 N,), before any plan, a fail-safe once the newest one has been played.
    """

    def __init__(self, u_hover: Array, fail_safe: FailSafe, settings: ControllerSettings) -> None:
        self._u_hover = u_hover
        self.fail_safe = fail_safe
        self._lower = settings.lower(1)  # limits of the inputs of a UAV, (4,)
        self._upper = settings.upper(1)
        self._step = settings.largest_step(1)  # largest change in a sampling period, (4,)
        uavs = len(u_hover) // state.INPUTS
        self._plans: list[list[Plan]] = [[] for _ in range(uavs)]
        self._period_s = settings.sampling_period_s
        # Force of the integral of each UAV on a fail-safe that follows, N.
        self._held_I: dict[int, Array] = {}

    def add(self, plan: Plan) -> None:
        """Add a plan to the schedule of its UAVs, in any order of arrival."""
        for uav in plan.uavs:
            plans = self._plans[uav - 1]
            plans.append(plan)
            plans.sort(key=lambda each: (each.start_tick, each.tick))

    def inputs(self, tick: int, x: Array, u_before: Array) -> tuple[Array, tuple[int, ...]]:
        """Return the inputs over [t_k, t_{k+1}) and their sources.

        Ticks are asked for in their order: of the plans that have started, only the newest of each
        UAV is kept.

        Args:
            tick: Tick k.
            x: State at t_k, (n,), for the fail-safe.
            u_before: Inputs in force until t_k, (4 N,): the fail-safe's differ from them by what the
                actuators can change in a period.

        Returns: Inputs, (4 N,), and for each UAV the tick at which its plan was made, or another
            source.
        """
        u = self._u_hover.copy()
        sources = [BEFORE_ANY_PLAN] * len(self._plans)
        for uav in range(len(self._plans)):
            plan = self._newest_started(uav, tick)
            if plan is None:
                continue
            own = state.input_slice(uav)
            # A plan that repeats older inputs does not renew the time for which these are played.
            if plan.played(tick) < self.fail_safe.played(len(plan.inputs), self._period_s):
                planned = state.input_slice(plan.uavs.index(uav + 1))
                u[own] = plan.inputs[tick - plan.start_tick, planned]
                sources[uav] = plan.tick
                self._held_I.pop(uav, None)
            else:
                u[own] = self._safe_inputs(uav, tick, x, u_before[own])
                sources[uav] = FAIL_SAFE
        return u, tuple(sources)

    def _newest_started(self, uav: int, tick: int) -> Plan | None:
        """Return the newest plan of a UAV, 0-based, that has started; forget those before it."""
        plans = self._plans[uav]
        started = [plan for plan in plans if plan.start_tick <= tick]
        if not started:
            return None
        ahead = [plan for plan in plans if plan.start_tick > tick]
        self._plans[uav] = [started[-1], *ahead]
        return started[-1]

    def _safe_inputs(self, uav: int, tick: int, x: Array, before: Array) -> Array:
        """Return the fail-safe's inputs of a UAV, (4,), within rates and limits."""
        held_I = self._held_I.get(uav, np.zeros(3))
        safe = self.fail_safe.inputs(uav, x, tick, held_I)
        self._held_I[uav] = self.fail_safe.held(uav, x, tick, held_I, self._period_s)
        safe = np.clip(safe, before - self._step, before + self._step)
        return np.clip(safe, self._lower, self._upper)


class InnerLoop(Protocol):
    """The inner loops of all UAVs, with their state.

    Evaluated in equal steps of at most `INNER_STEP_S`.
    """

    failure: str  # why the run ends, as an inner loop has failed; empty while all work

    def reset(self, x: Array) -> None:
        """Continue from a plant state, (12 + 12 N,), which may have jumped as a UAV failed."""

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments of the motors until the next call, (N, 4), N and N m.

        command: thrust and body rates of each UAV, (N, 4), N and rad/s; x: plant state, (12 + 12 N,).
        """


class RateLoop:
    """The inner loop that the controllers predict with, sampled, with limits of the moments, (3,).

    Source: docs/equations.md (57).
    """

    failure = ""

    def __init__(self, system: System, limits_Nm: Array) -> None:
        self._inertia = np.array([uav.inertia for uav in system.uavs])
        self._gains = np.asarray(system.rate_gains)
        self._limits_Nm = limits_Nm

    def reset(self, x: Array) -> None:
        """Do nothing: this loop has no state."""

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments for commanded body rates, (N, 4), N and N m."""
        omega = x[state.PAYLOAD :].reshape(-1, state.PER_UAV)[:, state.OMEGA]
        error = command[:, 1:] - omega

        # tau = J K (omega_cmd - omega) + omega x (J omega), limited: (57).
        momentum = _each(self._inertia, omega)
        tau = _each(self._inertia, self._gains * error) + _cross(omega, momentum)

        inputs = command.copy()
        inputs[:, 1:] = np.minimum(np.maximum(tau, -self._limits_Nm), self._limits_Nm)
        return inputs


def _each(matrices: Array, vectors: Array) -> Array:
    """Return M_i v_i for each UAV i, (N, 3)."""
    return np.asarray(np.matmul(matrices, vectors[:, :, None])[:, :, 0])


# For each axis the next one, and the one after that.
_NEXT = np.array([1, 2, 0])
_AFTER_NEXT = np.array([2, 0, 1])


def _cross(a: Array, b: Array) -> Array:
    """Return a_i x b_i for each UAV i, (N, 3).

    It takes a fifth of the time of numpy.cross for a few vectors.
    """
    forward = a.take(_NEXT, axis=1) * b.take(_AFTER_NEXT, axis=1)
    backward = a.take(_AFTER_NEXT, axis=1) * b.take(_NEXT, axis=1)
    return np.asarray(forward - backward)


def inner_loop(setup: PlantRun, step_s: float) -> InnerLoop | None:
    """Return the inner loop of a run, if any, called every `step_s`.

    Raises: ScenarioError: no firmware starts.
    """
    if setup.run.settings.inputs == "moments":
        return None
    if setup.section.inner_loop != "betaflight":
        return RateLoop(setup.run.system, np.array(setup.run.settings.limits.moments_Nm))
    firmware: InnerLoop = importlib.import_module(_FIRMWARE).Betaflight(setup, step_s)
    return firmware


def checked_firmware(setup: PlantRun) -> str:
    """Return name and version of the firmware of a run, or of its autopilots, if any.

    Raises: ScenarioError: it is not usable.
    """
    if setup.section.autopilot is not None:
        return str(importlib.import_module(_AUTOPILOTS).version(setup))
    if setup.section.inner_loop != "betaflight":
        return ""
    return str(importlib.import_module(_FIRMWARE).version(setup))


class Rotors:
    """Four equal rotors of a UAV.

    `mixing` has thrust and moments per rotor thrust, (4, 4), the moments in m. Its columns are front
    right, rear left (both turn counterclockwise seen from above), front left, rear right
    (clockwise); arms are at 45 deg to the axes, x forward, z down.
    """

    def __init__(self, section: RotorsSection) -> None:
        self._least_N, self._most_N = section.thrust_N
        s = section.arm_m / np.sqrt(2.0)
        k = section.drag_to_thrust_m
        # f = sum f_j, tau = sum (-y_j f_j, x_j f_j, +-k f_j) of thrusts f_j at (x_j, y_j): (56).
        self.mixing: Array = np.array(
            [
                [1.0, 1.0, 1.0, 1.0],
                [-s, s, s, -s],
                [s, -s, s, -s],
                [k, k, -k, -k],
            ]
        )
        self._back = np.linalg.inv(self.mixing)

    def thrusts(self, inputs: Array) -> Array:
        """Return the thrusts of the rotors that make inputs, (N, 4) each."""
        return np.asarray(inputs @ self._back.T)

    def limited(self, inputs: Array) -> Array:
        """Return the inputs that limited rotors make of commands, (N, 4).

        Source: docs/equations.md (56).
        """
        thrusts = self.thrusts(inputs)
        change = np.clip(thrusts, self._least_N, self._most_N) - thrusts
        # The difference alone is mixed back, so that commands within the limits pass without
        # rounding.
        limited: Array = inputs + change @ self.mixing.T
        return limited


class Motors:
    """Motors of all UAVs, with their state: hover at first, (4 N,).

    `factors` are what the motors of each UAV give over their commands, (N,). `fails` tells that an
    efficiency will change during the run. Motors without lag, steps, limits
    and failures are `ideal`: actual inputs are the commands, and are not recorded a second time. Those
    of a UAV whose motors are off are zero, also where an inner loop has given some.
    """

    def __init__(
        self,
        section: MotorsSection,
        u_hover: Array,
        *,
        fails: bool = False,
        factors: Array | None = None,
    ) -> None:
        of_uavs = np.ones(len(u_hover) // state.INPUTS) if factors is None else factors
        fails = fails or bool((of_uavs != 1.0).any())
        self.ideal = not (fails or section.lag_s or section.thrust_step_N or section.rotors)
        self._section = section
        self._rotors = None if section.rotors is None else Rotors(section.rotors)
        self._a: Array = u_hover.copy()  # what the lag has reached
        self._factors = of_uavs
        self._efficiency = np.repeat(of_uavs, state.INPUTS)

    def degrade(self, uav: int, efficiency: float) -> None:
        """Set the share of its usual inputs that a UAV's motors, 0-based, give from now on.

        0 with the motors off.
        """
        self._efficiency[state.input_slice(uav)] = self._factors[uav] * efficiency

    def inputs(self, u: Array, period_s: float, steps: int) -> Iterator[tuple[Array, float]]:
        """Yield the actual inputs over a period, (4 N,), and how long each is held, s.

        The state of the motors advances with them. Without lag there is one input for the period,
        with lag there are two for each integration step. Source: docs/equations.md (53), (54).

        Args:
            u: Command, held over the period, (4 N,).
            period_s: Its length.
            steps: Integration steps in it.
        """
        if self.ideal:
            yield self._efficiency * u, period_s
            return
        command = self._limited(u)
        if self._section.lag_s == 0.0:
            yield self._efficiency * command, period_s
            return
        for _ in range(steps):
            halves, self._a = self._held_inputs(command, period_s / steps)
            for half in halves:
                yield self._efficiency * half, period_s / steps / 2.0

    def _held_inputs(self, command: Array, step_s: float) -> tuple[tuple[Array, Array], Array]:
        """Return two inputs for half a step each, and those at its end, (4 N,).

        Source: docs/equations.md (54), (56a).
        """
        rotors = self._rotors
        section = self._section
        with_one_lag = motors.two_held_inputs(self._a, command, section.lag_s, step_s)
        if rotors is None or section.falling_lag_s is None:
            return with_one_lag

        (first_up, second_up), end_up = with_one_lag
        (first_down, second_down), end_down = motors.two_held_inputs(
            self._a, command, section.falling_lag_s, step_s
        )
        falls = rotors.thrusts((command - self._a).reshape(-1, state.INPUTS)) < 0.0
        first = _with_falling(rotors, falls, first_up, first_down)
        second = _with_falling(rotors, falls, second_up, second_down)
        return (first, second), _with_falling(rotors, falls, end_up, end_down)

    def _limited(self, u: Array) -> Array:
        """Return commands in steps of the thrust and within the limits of the rotors, (4 N,)."""
        inputs = u.reshape(-1, state.INPUTS).copy()
        step_N = self._section.thrust_step_N
        if step_N:
            inputs[:, 0] = np.round(inputs[:, 0] / step_N) * step_N
        if self._rotors is not None:
            inputs = self._rotors.limited(inputs)
        return inputs.reshape(-1)


def _with_falling(rotors: Rotors, falls: npt.NDArray[np.bool_], up: Array, down: Array) -> Array:
    """Return inputs, (4 N,): thrusts of the rotors that fall, (N, 4), as in `down`, else as in `up`.

    up + M s, with M the mixing and s = M^-1 (down - up) of a rotor that falls, else 0.
    Source: docs/equations.md (56a).
    """
    change = rotors.thrusts((down - up).reshape(falls.shape))
    of_falling = np.where(falls, change, 0.0)
    return np.asarray(up + (of_falling @ rotors.mixing.T).reshape(-1))
