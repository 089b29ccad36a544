"""The system in MuJoCo, as an independent physics engine.

Rods are bodies on ball joints. MuJoCo's compiler refuses bodies without mass, so each rod is compiled with a mass that
is set to zero afterwards, except for a moment of inertia about the rod's own axis. With e . Omega = 0 this inertia has
no angular momentum and no torque acts on it, so the engine's accelerations are exactly those of a massless rod. A
second ball joint carries the UAV with its full inertia.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from model import state
from model.arrays import Array
from model.parameters import System
from model.state import StateView
from tests.support.paper_form import K, attitude, thrust_forces

_ROD_SPIN_INERTIA = (
    1.0  # kg m^2; the motion does not depend on it, and this value keeps the mass matrix well conditioned
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Accelerations:
    """The engine's results.

    Attributes:
        payload_I: Acceleration of the payload's centre of mass, (3,), inertial frame, m/s^2.
        payload_turn_I: Angular acceleration of the payload, (3,), inertial frame, rad/s^2.
        rods_turn_I: Angular accelerations of the rods, (N, 3), inertial frame, rad/s^2.
        uavs_I: Accelerations of the UAVs' centres of mass, (N, 3), inertial frame, m/s^2.
        uavs_turn_I: Angular accelerations of the UAVs, (N, 3), inertial frame, rad/s^2.
    """

    payload_I: Array
    payload_turn_I: Array
    rods_turn_I: Array
    uavs_I: Array
    uavs_turn_I: Array


def accelerations(system: System, x: Array, u: Array, forces: Array | None = None) -> Accelerations:
    """Evaluate MuJoCo's forward dynamics at one state and input, under forces on payload and UAVs, (3 + 3 N,)."""
    engine = _engine(system)
    data = mujoco.MjData(engine)
    _place(system, engine, data, x)
    attitudes = [attitude(Theta) for Theta in StateView(x).Theta]
    external = np.zeros((1 + system.N, 3)) if forces is None else forces.reshape(-1, 3)
    data.xfrc_applied[engine.body("payload").id][:3] = external[0]
    for i, (force_I, R) in enumerate(zip(thrust_forces(x, u) + external[1:], attitudes, strict=True)):
        data.xfrc_applied[engine.body(f"uav{i}").id] = [*force_I, *(R @ u[state.input_slice(i)][1:])]
    mujoco.mj_forward(engine, data)
    mujoco.mj_rnePostConstraint(engine, data)

    def of(name: str) -> tuple[Array, Array]:
        spatial = np.zeros(6)
        mujoco.mj_objectAcceleration(engine, data, mujoco.mjtObj.mjOBJ_BODY, engine.body(name).id, spatial, 0)
        # MuJoCo reports accelerometer values: gravity counts as an acceleration of the world.
        return spatial[:3], spatial[3:] + system.gravity * K

    payload = of("payload")
    rods = [of(f"rod{i}") for i in range(system.N)]
    uavs = [of(f"uav{i}") for i in range(system.N)]
    return Accelerations(
        payload_I=payload[1],
        payload_turn_I=payload[0],
        rods_turn_I=np.array([turn for turn, _ in rods]),
        uavs_I=np.array([linear for _, linear in uavs]),
        uavs_turn_I=np.array([turn for turn, _ in uavs]),
    )


def motion(system: System, x: Array, u: Array, duration_s: float) -> list[Array]:
    """Return the state after `duration_s` of held input: SciPy's DOP853 about MuJoCo's forward dynamics.

    Attitudes are quaternions here, so there is no singularity. Returns: payload position and velocity (inertial frame),
    attitude, angular velocity; rod directions and angular velocities (payload frame); UAV attitudes and rates.
    """
    engine, N = _engine(system), system.N
    data = mujoco.MjData(engine)
    _place(system, engine, data, x)
    positions, turns = len(data.qpos), [3 + 4 * k for k in range(1 + 2 * N)]  # beginnings of the quaternions

    def derivative(_: float, y: Array) -> Array:
        for at in turns:
            y[at : at + 4] /= np.linalg.norm(y[at : at + 4])
        data.qpos, data.qvel = y[:positions], y[positions:]
        mujoco.mj_kinematics(engine, data)
        for i in range(N):
            R = data.body(f"uav{i}").xmat.reshape(3, 3)
            thrust, *tau = u[state.input_slice(i)]
            data.xfrc_applied[engine.body(f"uav{i}").id] = [*(-thrust * R[:, 2]), *(R @ tau)]
        mujoco.mj_forward(engine, data)
        rates = np.zeros(positions)
        rates[:3] = data.qvel[:3]
        for k, at in enumerate(turns):
            w, v, omega = y[at], y[at + 1 : at + 4], data.qvel[3 + 3 * k : 6 + 3 * k]
            rates[at : at + 4] = 0.5 * np.array([-v @ omega, *(w * omega + np.cross(v, omega))])
        return np.concatenate([rates, data.qacc])

    start = np.concatenate([data.qpos, data.qvel])
    end = solve_ivp(derivative, (0.0, duration_s), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    R = [_matrix(end[at : at + 4]) for at in turns]
    rates = end[positions + 3 :].reshape(-1, 3)
    R0, omega0 = R[0], rates[0]
    Omega = [omega0 + R[1 + 2 * i] @ rates[1 + 2 * i] for i in range(N)]
    attitudes = [R0 @ R[1 + 2 * i] @ R[2 + 2 * i] for i in range(N)]
    return [
        end[:3],
        end[positions : positions + 3],
        R0,
        omega0,
        np.array([R[1 + 2 * i][:, 2] for i in range(N)]),
        np.array(Omega),
        np.array(attitudes),
        np.array([rates[2 + 2 * i] + attitudes[i].T @ R0 @ Omega[i] for i in range(N)]),
    ]


def _engine(system: System) -> mujoco.MjModel:
    """Return the system compiled, with massless rods."""
    engine = mujoco.MjModel.from_xml_string(_xml(system))
    for i in range(system.N):
        rod = engine.body(f"rod{i}").id
        engine.body_mass[rod] = 0.0
        engine.body_inertia[rod] = [0.0, 0.0, _ROD_SPIN_INERTIA]
    return engine


def _place(system: System, engine: mujoco.MjModel, data: mujoco.MjData, x: Array) -> None:
    """Write the state into MuJoCo's coordinates: quaternions and rates relative to the parent body."""
    view = StateView(x)
    R0 = attitude(view.Theta0)
    data.joint("payload").qpos = [*view.r0_I, *_quaternion(R0)]
    data.joint("payload").qvel = [*(R0 @ view.v0_P), *view.omega0_P]
    for i in range(system.N):
        e, Omega, omega = view.e_P[i], view.Omega_P[i], view.omega_B[i]
        rod_P, R = _rotation_to(e), attitude(view.Theta[i])
        data.joint(f"rod{i}").qpos = _quaternion(rod_P)
        data.joint(f"rod{i}").qvel = rod_P.T @ (Omega - view.omega0_P)
        data.joint(f"uav{i}").qpos = _quaternion((R0 @ rod_P).T @ R)
        data.joint(f"uav{i}").qvel = omega - R.T @ R0 @ Omega


def _rotation_to(e: Array) -> Array:
    """Return a rotation that turns the z axis onto e, (3, 3): the third column is e."""
    least = np.eye(3)[np.argmin(np.abs(e))]  # the axis farthest from e, so that the product is far from zero
    first = np.cross(least, e) / np.linalg.norm(np.cross(least, e))
    return np.column_stack([first, np.cross(e, first), e])


def _matrix(quaternion: Array) -> Array:
    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def _quaternion(R: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R).as_quat(scalar_first=True))


def _xml(system: System) -> str:
    vehicles = "".join(
        f'<body name="rod{i}" pos="{_numbers(uav.rho)}"><joint name="rod{i}" type="ball"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        f'<body name="uav{i}" pos="0 0 {-uav.rod_length!r}"><joint name="uav{i}" type="ball"/>'
        f"{_inertial(uav.mass, uav.inertia)}</body></body>"
        for i, uav in enumerate(system.uavs)
    )
    return (
        f'<mujoco><option gravity="0 0 {system.gravity!r}"/><worldbody>'
        f'<body name="payload"><freejoint name="payload"/>{_inertial(system.payload.mass, system.payload.inertia)}'
        f"{vehicles}</body></worldbody></mujoco>"
    )


def _inertial(mass: float, J: Array) -> str:
    full = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    return f'<inertial pos="0 0 0" mass="{mass!r}" fullinertia="{_numbers(full)}"/>'


def _numbers(values: Array | list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
