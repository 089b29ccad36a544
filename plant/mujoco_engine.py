"""The engine "mujoco": the team as bodies of the physics engine MuJoCo, with ground, contacts and rods with a mass."""

import math
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array
from transport.model.hover import RELEASED_MASS_KG
from transport.model.parameters import System, payload_half_size
from transport.model.rotations import euler_angles, rotation
from transport.model.state import StateView
from transport.protocol.scenario.plant_sections import PlantSection

# Radius of the sphere with which a UAV touches the ground, m.
_UAV_RADIUS_M = 0.1
# Contact pairs: the ground meets payload and UAVs; these do not meet each other.
_GROUND, _MEETS_GROUND = {"contype": 1, "conaffinity": 0}, {"contype": 0, "conaffinity": 1}
# Time constant, s, and damping ratio of the limit on the length of a cable, and its share of a
# rigid one: a cable of the paper's team is less than 0.1 mm longer under load.
_CABLE: dict[str, Any] = {
    "solref_limit": [0.01, 1.0],
    "solimp_limit": [0.99, 0.999, 0.001, 0.5, 2.0],
}
# Inputs of a UAV as forces and moments in its frame: thrust along -b3, three moments.
_GEARS = np.vstack([[0, 0, -1, 0, 0, 0], np.eye(3, 6, k=3)])

# MuJoCo would write its warnings into a file in the current folder; a run that becomes unstable
# ends as diverged.
mujoco.set_mju_user_warning(lambda _: None)


class MujocoEngine:
    """MuJoCo, by Runge-Kutta steps of order 4 of at most `plant.mujoco.step_s`.

    Attributes:
        tensions: Least tension of each cable in the last interval, (N,), N, 0 while it is slack;
            (0,) with rods.
    """

    version = mujoco.__version__

    def __init__(self, system: System, section: PlantSection) -> None:
        self._system, self._section = system, section
        self._cables = section.mujoco.suspension == "cables"
        self._model = _specification(system, section).compile()
        self._data = mujoco.MjData(self._model)
        self.tensions = np.zeros(system.N if self._cables else 0)
        self._turns = np.zeros(
            (1 + system.N, 3)
        )  # attitudes of the last state, of payload and UAVs

    def reset(self, x: Array) -> None:
        """Continue from a state, (n,): without memory of earlier contacts and solutions."""
        view, system, data = StateView(x), self._system, self._data
        mujoco.mj_resetData(self._model, data)
        R0 = rotation(view.Theta0)
        _set(
            data.joint("payload"),
            [*view.r0_I, *_quaternion(R0)],
            [*(R0 @ view.v0_P), *view.omega0_P],
        )
        for i, uav in enumerate(system.uavs):
            e_P, Omega_P, omega_B, R = (
                view.e_P[i],
                view.Omega_P[i],
                view.omega_B[i],
                rotation(view.Theta[i]),
            )
            if self._cables:
                r_I = view.r0_I + R0 @ (uav.rho - uav.rod_length * e_P)
                swing_P = uav.rod_length * np.cross(Omega_P, e_P)
                v_I = R0 @ (view.v0_P + np.cross(view.omega0_P, uav.rho) - swing_P)
                _set(data.joint(f"uav{i}"), [*r_I, *_quaternion(R)], [*v_I, *omega_B])
            else:
                # A rotation whose third column is e, from the axis farthest from it.
                first = np.cross(np.eye(3)[np.argmin(np.abs(e_P))], e_P)
                first = first / np.linalg.norm(first)
                rod_P = np.column_stack([first, np.cross(e_P, first), e_P])
                _set(data.joint(f"rod{i}"), _quaternion(rod_P), rod_P.T @ (Omega_P - view.omega0_P))
                _set(
                    data.joint(f"uav{i}"),
                    _quaternion((R0 @ rod_P).T @ R),
                    omega_B - R.T @ R0 @ Omega_P,
                )
        self._turns = np.vstack([view.Theta0[None], view.Theta])

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> None:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,)."""
        model, data = self._model, self._data
        steps = math.ceil(duration_s / self._section.mujoco.step_s - 1e-9)
        model.opt.timestep = duration_s / steps
        data.ctrl[:] = u
        data.xfrc_applied[:] = 0.0
        if forces is not None:
            bodies = [data.body("payload"), *(data.body(f"uav{i}") for i in range(self._system.N))]
            for body, force_I in zip(bodies, forces.reshape(-1, 3), strict=True):
                body.xfrc_applied[:3] = force_I
        if not self._cables:
            mujoco.mj_step(model, data, nstep=steps)
            return
        self.tensions = np.full(self._system.N, np.inf)
        for _ in range(steps):
            mujoco.mj_step(model, data)
            pulling, pulls = (
                data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON,
                np.zeros(self._system.N),
            )
            pulls[data.efc_id[pulling]] = data.efc_force[pulling]
            self.tensions = np.minimum(self.tensions, pulls)

    def state(self) -> Array:
        """Return the present state, (n,)."""
        data, x = self._data, np.zeros(self._system.n)
        view, payload = StateView(x), data.joint("payload")
        R0 = _matrix(payload.qpos[3:])
        view.r0_I[:] = payload.qpos[:3]
        view.v0_P[:] = R0.T @ payload.qvel[:3]
        view.omega0_P[:] = payload.qvel[3:]
        attitudes = [R0]
        for i, uav in enumerate(self._system.uavs):
            joint = data.joint(f"uav{i}")
            if self._cables:
                R = _matrix(joint.qpos[3:])
                along_P = uav.rho + R0.T @ (view.r0_I - joint.qpos[:3])
                towards_P = view.v0_P + _cross(view.omega0_P, uav.rho) - R0.T @ joint.qvel[:3]
                length = np.linalg.norm(along_P)
                e_P = along_P / length
                Omega_P = _cross(e_P, towards_P) / length
                view.omega_B[i] = joint.qvel[3:]
            else:
                rod = data.joint(f"rod{i}")
                rod_P, turn = _matrix(rod.qpos), _matrix(joint.qpos)
                e_P, R = rod_P[:, 2], R0 @ rod_P @ turn
                spinning_P = view.omega0_P + rod_P @ rod.qvel
                Omega_P = spinning_P - e_P * (e_P @ spinning_P)
                view.omega_B[i] = joint.qvel + R.T @ R0 @ spinning_P
            view.e_P[i], view.Omega_P[i] = e_P, Omega_P
            attitudes.append(R)
        angles = euler_angles(np.array(attitudes))
        # Roll and yaw continue beyond half a turn, as when they are integrated.
        self._turns = angles + 2.0 * math.pi * np.round((self._turns - angles) / (2.0 * math.pi))
        view.Theta0[:], view.Theta[:] = self._turns[0], self._turns[1:]
        return x


def _set(joint: Any, qpos: Any, qvel: Any) -> None:
    joint.qpos[:], joint.qvel[:] = qpos, qvel


def _quaternion(R: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R).as_quat(scalar_first=True))


def _matrix(quaternion: Array) -> Array:
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, quaternion)
    return found.reshape(3, 3)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors, (3,), at a tenth of the time of numpy.cross."""
    found = np.empty(3)
    mujoco.mju_cross(found, a, b)
    return found


def _specification(system: System, section: PlantSection) -> Any:
    """Return the team as a model of MuJoCo, world frame = inertial frame with z down.

    A rod is a body on a ball joint at the payload, the UAV a body on a ball joint at the rod's
    other end, in its centre of mass. A cable is a tendon, which pulls at its full length and never
    pushes, between the payload and a free UAV.
    """
    spec, ball, geom = mujoco.MjSpec(), mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtGeom
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.gravity = [0.0, 0.0, system.gravity]
    # Not its own restart from the initial pose: a diverged run must end.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if section.ground_m is not None:
        # Half a turn about x: the normal points up, along -z.
        place = {"pos": [0.0, 0.0, section.ground_m], "quat": [0.0, 1.0, 0.0, 0.0]}
        spec.worldbody.add_geom(type=geom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], **place, **_GROUND)
    payload = spec.worldbody.add_body(
        name="payload", **_inertial(system.payload.mass, system.payload.inertia)
    )
    payload.add_freejoint(name="payload")
    payload.add_geom(type=geom.mjGEOM_BOX, size=payload_half_size(system), **_MEETS_GROUND)
    for i, uav in enumerate(system.uavs):
        inertial = _inertial(uav.mass, uav.inertia)
        if section.mujoco.suspension == "cables":
            body = spec.worldbody.add_body(name=f"uav{i}", **inertial)
            body.add_freejoint(name=f"uav{i}")
            payload.add_site(name=f"attachment{i}", pos=uav.rho)
            cable = spec.add_tendon(
                name=f"cable{i}", limited=True, range=[0.0, uav.rod_length], **_CABLE
            )
            cable.wrap_site(f"attachment{i}")
            cable.wrap_site(f"uav{i}")
        else:
            # A homogeneous thin rod. Its inertia about its own axis has no effect, as the ball
            # joints leave it without spin; the same value about all axes is well conditioned.
            mass, end = section.mujoco.rod_mass_kg, np.array([0.0, 0.0, -uav.rod_length])
            thin = {
                "mass": mass,
                "inertia": [mass * uav.rod_length**2 / 12.0] * 3,
                "ipos": end / 2.0,
            }
            rod = payload.add_body(name=f"rod{i}", pos=uav.rho, explicitinertial=True, **thin)
            rod.add_joint(name=f"rod{i}", type=ball)
            body = rod.add_body(name=f"uav{i}", pos=end, **inertial)
            body.add_joint(name=f"uav{i}", type=ball)
        if (
            uav.mass > RELEASED_MASS_KG
        ):  # a released UAV is a bob below the payload, which may lie on the ground
            body.add_geom(type=geom.mjGEOM_SPHERE, size=[_UAV_RADIUS_M, 0.0, 0.0], **_MEETS_GROUND)
        body.add_site(name=f"uav{i}")
        for gear in _GEARS:
            spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_SITE, target=f"uav{i}", gear=gear)
    return spec


def _inertial(mass: float, J: Array) -> dict[str, Any]:
    full = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    return {"mass": mass, "fullinertia": full, "ipos": np.zeros(3), "explicitinertial": True}
