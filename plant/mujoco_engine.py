"""The engine "mujoco": the team as bodies of MuJoCo, with ground, contacts and rods with a mass."""

import math
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array
from transport.model.physics.hover import RELEASED_MASS_KG
from transport.model.physics.parameters import System, Uav, payload_half_size
from transport.model.physics.rotations import euler_angles, rotation
from transport.model.state import StateView
from transport.protocol.scenario.sections.plant_sections import PlantSection

_ROUNDING = 1e-9  # of a whole number of steps
# Radius of the sphere with which a UAV touches the ground, m.
_UAV_RADIUS_M = 0.1
# Contact pairs: the ground meets payload and UAVs; these do not meet each other.
_GROUND = {"contype": 1, "conaffinity": 0}
_MEETS_GROUND = {"contype": 0, "conaffinity": 1}
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
        self._system = system
        self._section = section
        self._cables = section.mujoco.suspension == "cables"
        self._model = _specification(system, section).compile()
        self._data = mujoco.MjData(self._model)
        self.tensions = np.zeros(system.N if self._cables else 0)
        names = ["payload", *(f"uav{i}" for i in range(system.N))]
        self._bodies = [self._model.body(name).id for name in names]
        drags = [[system.payload.drag] * 2, *(uav.drag for uav in system.uavs)]
        self._coefficients = np.array(drags)
        # Attitudes of the last state, of payload and UAVs, (1 + N, 3).
        self._turns = np.zeros((1 + system.N, 3))

    def reset(self, x: Array) -> None:
        """Continue from a state, (n,): without memory of earlier contacts and solutions."""
        view = StateView(x)
        mujoco.mj_resetData(self._model, self._data)
        R0 = rotation(view.Theta0)
        place = [*view.r0_I, *_quaternion(R0)]
        motion = [*(R0 @ view.v0_P), *view.omega0_P]
        _set(self._data.joint("payload"), place, motion)

        for i in range(self._system.N):
            if self._cables:
                self._place_on_cable(view, R0, i)
            else:
                self._place_on_rod(view, R0, i)
        self._turns = np.vstack([view.Theta0[None], view.Theta])

    def _place_on_cable(self, view: StateView, R0: Array, i: int) -> None:
        """Place a free UAV, 0-based, at the end of its straight cable."""
        uav = self._system.uavs[i]
        e_P = view.e_P[i]

        # r_i = r_0 + R_0 (rho_i - l_i e_i), and its derivative in the payload frame.
        r_I = view.r0_I + R0 @ (uav.rho - uav.rod_length * e_P)
        swing_P = uav.rod_length * np.cross(view.Omega_P[i], e_P)
        v_I = R0 @ (view.v0_P + np.cross(view.omega0_P, uav.rho) - swing_P)

        attitude = _quaternion(rotation(view.Theta[i]))
        joint = self._data.joint(f"uav{i}")
        _set(joint, [*r_I, *attitude], [*v_I, *view.omega_B[i]])

    def _place_on_rod(self, view: StateView, R0: Array, i: int) -> None:
        """Turn a rod and the UAV at its end, 0-based, by their ball joints."""
        e_P = view.e_P[i]
        Omega_P = view.Omega_P[i]
        R = rotation(view.Theta[i])

        # A rotation whose third column is e, from the axis farthest from it.
        first = np.cross(np.eye(3)[np.argmin(np.abs(e_P))], e_P)
        first = first / np.linalg.norm(first)
        rod_P = np.column_stack([first, np.cross(e_P, first), e_P])

        spin_rod = rod_P.T @ (Omega_P - view.omega0_P)
        _set(self._data.joint(f"rod{i}"), _quaternion(rod_P), spin_rod)
        spin_B = view.omega_B[i] - R.T @ R0 @ Omega_P
        _set(self._data.joint(f"uav{i}"), _quaternion((R0 @ rod_P).T @ R), spin_B)

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> None:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,)."""
        model = self._model
        data = self._data
        steps = math.ceil(duration_s / self._section.mujoco.step_s - _ROUNDING)
        model.opt.timestep = duration_s / steps
        data.ctrl[:] = u
        held_I = np.zeros(3 + 3 * self._system.N) if forces is None else forces
        data.xfrc_applied[self._bodies, :3] = held_I.reshape(-1, 3)

        if not (self._cables or self._system.has_drag):
            mujoco.mj_step(model, data, nstep=steps)
            return
        if self._cables:
            self.tensions = np.full(self._system.N, np.inf)
        for _ in range(steps):
            if self._system.has_drag:
                data.xfrc_applied[self._bodies, :3] = held_I.reshape(-1, 3) + self._drag()
            mujoco.mj_step(model, data)
            if self._cables:
                self.tensions = np.minimum(self.tensions, self._pulls())

    def _drag(self) -> Array:
        """Return the drag of payload and UAVs in still air before a step, (1 + N, 3), world frame, N.

        -d v - (d^z - d) (b . v) b; docs/equations.md (42). It is held over the step.
        """
        model = self._model
        data = self._data
        # After a step the places and velocities of bodies are those of its last stage.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)

        velocity = np.empty(6)
        drag = np.empty((1 + self._system.N, 3))
        for row, body in enumerate(self._bodies):
            # Rotation and velocity of its origin, the centre of mass, along the world's axes.
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, False)
            v_I = velocity[3:]
            across, along = self._coefficients[row]
            b_I = data.xmat[body].reshape(3, 3)[:, 2]
            drag[row] = -across * v_I - (along - across) * (b_I @ v_I) * b_I
        return drag

    def _pulls(self) -> Array:
        """Return the tensions of the cables after a step, (N,), N: the forces at their limits."""
        data = self._data
        pulls = np.zeros(self._system.N)
        pulling = data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON
        pulls[data.efc_id[pulling]] = data.efc_force[pulling]
        return pulls

    def state(self) -> Array:
        """Return the present state, (n,)."""
        x = np.zeros(self._system.n)
        view = StateView(x)
        payload = self._data.joint("payload")
        R0 = _matrix(payload.qpos[3:])
        view.r0_I[:] = payload.qpos[:3]
        view.v0_P[:] = R0.T @ payload.qvel[:3]
        view.omega0_P[:] = payload.qvel[3:]

        read = self._read_cable if self._cables else self._read_rod
        attitudes = [R0, *(read(view, R0, i) for i in range(self._system.N))]
        angles = euler_angles(np.array(attitudes))
        # Roll and yaw continue beyond half a turn, as when they are integrated.
        self._turns = angles + 2.0 * math.pi * np.round((self._turns - angles) / (2.0 * math.pi))
        view.Theta0[:] = self._turns[0]
        view.Theta[:] = self._turns[1:]
        return x

    def _read_cable(self, view: StateView, R0: Array, i: int) -> Array:
        """Write cable and rates of a free UAV, 0-based, into a state; return its attitude R_i."""
        uav = self._system.uavs[i]
        joint = self._data.joint(f"uav{i}")

        # l e = rho - R_0'(r_i - r_0), and e x its derivative is l Omega.
        along_P = uav.rho + R0.T @ (view.r0_I - joint.qpos[:3])
        towards_P = view.v0_P + _cross(view.omega0_P, uav.rho) - R0.T @ joint.qvel[:3]
        length = np.linalg.norm(along_P)
        e_P = along_P / length

        view.e_P[i] = e_P
        view.Omega_P[i] = _cross(e_P, towards_P) / length
        view.omega_B[i] = joint.qvel[3:]
        return _matrix(joint.qpos[3:])

    def _read_rod(self, view: StateView, R0: Array, i: int) -> Array:
        """Write rod and rates of a UAV, 0-based, into a state; return its attitude R_i."""
        joint = self._data.joint(f"uav{i}")
        rod = self._data.joint(f"rod{i}")
        rod_P = _matrix(rod.qpos)
        turn = _matrix(joint.qpos)
        e_P = rod_P[:, 2]
        R = R0 @ rod_P @ turn

        spinning_P = view.omega0_P + rod_P @ rod.qvel
        view.e_P[i] = e_P
        view.Omega_P[i] = spinning_P - e_P * (e_P @ spinning_P)  # without spin about the rod
        view.omega_B[i] = joint.qvel + R.T @ R0 @ spinning_P
        return R


def _set(joint: Any, qpos: Any, qvel: Any) -> None:
    """Set position and velocity of a joint."""
    joint.qpos[:] = qpos
    joint.qvel[:] = qvel


def _quaternion(R: Array) -> Array:
    """Return the quaternion of a rotation, (w, x, y, z)."""
    return np.asarray(Rotation.from_matrix(R).as_quat(scalar_first=True))


def _matrix(quaternion: Array) -> Array:
    """Return the rotation of a quaternion (w, x, y, z), (3, 3)."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quaternion)
    return R.reshape(3, 3)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors, (3,), at a tenth of the time of numpy.cross."""
    product = np.empty(3)
    mujoco.mju_cross(product, a, b)
    return product


def _specification(system: System, section: PlantSection) -> Any:
    """Return the team as a model of MuJoCo, world frame = inertial frame with z down.

    A rod is a body on a ball joint at the payload, the UAV a body on a ball joint at the rod's
    other end, in its centre of mass. A cable is a tendon, which pulls at its full length and never
    pushes, between the payload and a free UAV.
    """
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.gravity = [0.0, 0.0, system.gravity]
    # Not its own restart from the initial pose: a diverged run must end.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if section.ground_m is not None:
        # Half a turn about x: the normal points up, along -z.
        place = {"pos": [0.0, 0.0, section.ground_m], "quat": [0.0, 1.0, 0.0, 0.0]}
        plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0.0, 0.0, 1.0]}
        spec.worldbody.add_geom(**plane, **place, **_GROUND)

    inertial = _inertial(system.payload.mass, system.payload.inertia)
    payload = spec.worldbody.add_body(name="payload", **inertial)
    payload.add_freejoint(name="payload")
    centre = -system.payload.centre  # of the box, from the centre of mass
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": payload_half_size(system), "pos": centre}
    payload.add_geom(**box, **_MEETS_GROUND)

    for i, uav in enumerate(system.uavs):
        if section.mujoco.suspension == "cables":
            body = _add_on_cable(spec, payload, i, uav)
        else:
            body = _add_on_rod(payload, i, uav, section.mujoco.rod_mass_kg)
        _equip(spec, body, i, uav)
    return spec


def _add_on_cable(spec: Any, payload: Any, i: int, uav: Uav) -> Any:
    """Add a free UAV, 0-based, and the cable between it and the payload; return its body."""
    body = spec.worldbody.add_body(name=f"uav{i}", **_inertial(uav.mass, uav.inertia))
    body.add_freejoint(name=f"uav{i}")
    payload.add_site(name=f"attachment{i}", pos=uav.rho)
    lengths_m = [0.0, uav.rod_length]
    cable = spec.add_tendon(name=f"cable{i}", limited=True, range=lengths_m, **_CABLE)
    cable.wrap_site(f"attachment{i}")
    cable.wrap_site(f"uav{i}")
    return body


def _add_on_rod(payload: Any, i: int, uav: Uav, rod_mass_kg: float) -> Any:
    """Add a homogeneous thin rod and the UAV, 0-based, at its end; return the UAV's body."""
    end = np.array([0.0, 0.0, -uav.rod_length])
    # Its inertia about its own axis has no effect, as the ball joints leave it without spin; the
    # same value about all axes is well conditioned.
    thin = {
        "mass": rod_mass_kg,
        "inertia": [rod_mass_kg * uav.rod_length**2 / 12.0] * 3,
        "ipos": end / 2.0,
    }
    ball = mujoco.mjtJoint.mjJNT_BALL
    rod = payload.add_body(name=f"rod{i}", pos=uav.rho, explicitinertial=True, **thin)
    rod.add_joint(name=f"rod{i}", type=ball)
    body = rod.add_body(name=f"uav{i}", pos=end, **_inertial(uav.mass, uav.inertia))
    body.add_joint(name=f"uav{i}", type=ball)
    return body


def _equip(spec: Any, body: Any, i: int, uav: Uav) -> None:
    """Give a UAV, 0-based, its contact with the ground, and its thrust and moments."""
    # A released UAV is a bob below the payload, which may lie on the ground.
    if uav.mass > RELEASED_MASS_KG:
        sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [_UAV_RADIUS_M, 0.0, 0.0]}
        body.add_geom(**sphere, **_MEETS_GROUND)
    body.add_site(name=f"uav{i}")
    for gear in _GEARS:
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_SITE, target=f"uav{i}", gear=gear)


def _inertial(mass: float, J: Array) -> dict[str, Any]:
    """Return mass and inertia of a body about its centre of mass, as MuJoCo takes them."""
    full = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    return {"mass": mass, "fullinertia": full, "ipos": np.zeros(3), "explicitinertial": True}
