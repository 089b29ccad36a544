"""The linear analysis of UAVs that all act alone (docs/equations.md (31a)-(31e), (31h), (60))."""

import numpy as np
import pytest

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System, table_1
from transport.model.physics.rotations import rotation
from transport.mpc.alone.alone_law import GAINS, AloneLaw
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion, ahead, motion_of, setpoint_of
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.loop_of_uavs_alone import AloneLoop

PERIOD_S = 0.05
SYSTEM = table_1()
RATES = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[25.0, 25.0, 10.0])
TICKS = 14
STEPS = 10  # of the integration in a period
DOWN = np.array([0.0, 0.0, 1.0])
# Deviations so small that their squares do not count, and the share of them that may differ.
SMALL = 1e-7
SAME = 1e-4


class Alone:
    """One UAV that acts by its law and its sensors, as an agent runs them."""

    def __init__(
        self, system: System, uav: int, ages: tuple[int, ...] | None, *, next_tick: bool
    ) -> None:
        at_rest = hover(system)
        self._system, self._uav, self._ages, self._next_tick = system, uav, ages, next_tick
        self._law = AloneLaw(system, uav, float(at_rest.u[4 * uav]))
        self._setpoint = setpoint_of(system, uav, at_rest.x, at_rest.u)
        self._tension_N = float(at_rest.tensions[uav])
        self._sensors = OwnSensors(system, uav, self._tension_N, ages or (0,) * 5, PERIOD_S)
        self._integral_I = np.zeros(3)

    def inputs(self, X: list[Array], in_force: Array) -> Array:
        """Return the inputs by the states so far, the newest last, and the inputs in force, (4,)."""
        start = int(self._next_tick)
        if self._ages is None:
            now = motion_of(self._system, self._uav, X[-1])
            motion = ahead(now, 0, start, self._reference, PERIOD_S)
        else:
            z = self._measured(
                [motion_of(self._system, self._uav, X[-1 - age]) for age in self._ages]
            )
            self._sensors.observe(z, self._tension_N, 0, self._reference)
            motion = self._sensors.motion(z, 0, start, self._reference)
        if self._next_tick:
            reference = self._reference(start)
            motion = self._law.driven(motion, self._setpoint, reference, in_force, PERIOD_S)

        inputs = self._law.inputs(motion, self._setpoint, self._integral_I)
        self._integral_I = self._law.integral_after(
            self._integral_I, motion, self._setpoint, PERIOD_S
        )
        return inputs

    def _reference(self, _: int) -> UavMotion:
        return self._setpoint.motion

    def _measured(self, by_age: list[UavMotion]) -> Array:
        """Return measurements, (15,), whose specific force has the direction of the rod."""
        position, velocity, attitude, rates, rod = by_age
        uav = self._system.uavs[self._uav]
        pull_I = self._tension_N * rod.rod_I / uav.rod_length
        pull_B = rotation(attitude.Theta).T @ pull_I
        specific = (pull_B - self._tension_N * DOWN) / uav.mass
        measured = [position.position_I, velocity.velocity_I, attitude.Theta, rates.omega_B]
        return np.concatenate([*measured, specific])


@pytest.mark.parametrize(
    ("system", "next_tick", "ages"),
    [
        (SYSTEM, False, None),
        (SYSTEM, True, None),
        (SYSTEM, False, (3, 1, 2, 1, 2)),
        (SYSTEM, True, (1, 2, 3, 0, 1)),
        (RATES, True, None),
        (RATES, True, (2, 1, 3, 1, 2)),
    ],
)
def test_loop_is_a_simulation_of_its_uavs(
    system: System, next_tick: bool, ages: tuple[int, ...] | None
) -> None:
    """From a small deviation its steps are those of the UAVs' laws, sensors and integrals on the nonlinear model."""
    at_rest, model = hover(system), Model(system)
    loop = AloneLoop(system, PERIOD_S, next_tick=next_tick, gains=GAINS, ages=ages)
    matrix = loop.matrix(Mismatch())
    T = tangent(at_rest.x)
    whole = np.zeros(len(matrix))
    whole[: T.shape[1]] = SMALL * np.random.default_rng(3).standard_normal(T.shape[1])

    team = [Alone(system, uav, ages, next_tick=next_tick) for uav in range(system.N)]
    X = [at_rest.x] * 5 + [at_rest.x + T @ whole[: T.shape[1]]]
    U = [at_rest.u]
    for _ in range(TICKS):
        in_force = [U[-1][state.input_slice(uav)] for uav in range(system.N)]
        U.append(np.concatenate([one.inputs(X, u) for one, u in zip(team, in_force, strict=True)]))
        X.append(model.advance(X[-1], U[-1 - next_tick], PERIOD_S, STEPS))

        whole = matrix @ whole
        expected = X[-1] - at_rest.x
        np.testing.assert_allclose(T @ whole[: T.shape[1]], expected, atol=SAME * SMALL)
