"""The team as bodies of MuJoCo: payload, rods or cables, UAVs, ground."""

from collections.abc import Iterable

from model.arrays import Array
from model.failure import RELEASED_MASS_KG
from model.parameters import System
from model.shape import payload_half_size
from protocol.scenario.plant_sections import PlantSection

# Radius of the sphere with which a UAV touches the ground, m.
_UAV_RADIUS_M = 0.1
# Contact pairs: the ground meets payload and UAVs; these do not meet each other.
_GROUND, _MEETS_GROUND = 'contype="1" conaffinity="0"', 'contype="0" conaffinity="1"'
# Time constant, s, and damping ratio of the limit on the length of a cable, and its share of a rigid one: a cable of
# the paper's team is less than 0.1 mm longer under load.
_CABLE = 'solreflimit="0.01 1" solimplimit="0.99 0.999 0.001"'
# Inputs of a UAV as forces and moments in its frame: thrust along -b3, three moments.
_GEARS = ("0 0 -1 0 0 0", "0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1")


def mjcf(system: System, section: PlantSection) -> str:
    """Return the team as a MuJoCo model (MJCF), world frame = inertial frame with z down.

    A rod is a body on a ball joint at the payload, the UAV a body on a ball joint at the rod's other end, in its centre
    of mass. A cable is a tendon, which pulls at its full length and never pushes, between the payload and a free UAV.
    """
    cables = section.mujoco.suspension == "cables"
    attached = "" if cables else "".join(_rod(system, section, i) for i in range(system.N))
    free = "".join(_uav(system, i, "freejoint", "") for i in range(system.N)) if cables else ""
    sites = "".join(f'<site name="attachment{i}" pos="{_text(uav.rho)}"/>' for i, uav in enumerate(system.uavs))
    tendons = "".join(
        f'<spatial name="cable{i}" limited="true" range="0 {uav.rod_length!r}" {_CABLE}>'
        f'<site site="attachment{i}"/><site site="uav{i}"/></spatial>'
        for i, uav in enumerate(system.uavs)
    )
    ground = ""
    if section.ground_m is not None:
        # Half a turn about x: the normal points up, along -z.
        ground = f'<geom type="plane" size="0 0 1" pos="0 0 {section.ground_m!r}" quat="0 1 0 0" {_GROUND}/>'
    motors = "".join(f'<motor site="uav{i}" gear="{gear}"/>' for i in range(system.N) for gear in _GEARS)
    return (
        f'<mujoco><option timestep="{section.mujoco.step_s!r}" integrator="RK4" gravity="0 0 {system.gravity!r}">'
        # Not its own restart from the initial pose: a diverged run must end.
        '<flag autoreset="disable"/></option>'
        f'<worldbody>{ground}<body name="payload"><freejoint name="payload"/>'
        f"{_inertial(system.payload.mass, system.payload.inertia)}"
        f'<geom type="box" size="{_text(payload_half_size(system))}" {_MEETS_GROUND}/>{sites}{attached}</body>{free}'
        f"</worldbody><tendon>{tendons if cables else ''}</tendon><actuator>{motors}</actuator></mujoco>"
    )


def _rod(system: System, section: PlantSection, i: int) -> str:
    """Return a homogeneous thin rod with its UAV.

    Its inertia about its own axis has no effect, as the ball joints leave it without spin; the same value about all
    axes is well conditioned.
    """
    uav, mass = system.uavs[i], section.mujoco.rod_mass_kg
    inertia = mass * uav.rod_length**2 / 12.0
    return (
        f'<body name="rod{i}" pos="{_text(uav.rho)}"><joint name="rod{i}" type="ball"/>'
        f'<inertial pos="0 0 {-uav.rod_length / 2.0!r}" mass="{mass!r}" diaginertia="{_text([inertia] * 3)}"/>'
        f"{_uav(system, i, 'joint', f'0 0 {-uav.rod_length!r}')}</body>"
    )


def _uav(system: System, i: int, joint: str, pos: str) -> str:
    uav = system.uavs[i]
    # A released UAV is a bob below the payload, which may lie on the ground.
    ball = f'<geom type="sphere" size="{_UAV_RADIUS_M}" {_MEETS_GROUND}/>' if uav.mass > RELEASED_MASS_KG else ""
    kind = ' type="ball"' if joint == "joint" else ""
    place = f' pos="{pos}"' if pos else ""
    return (
        f'<body name="uav{i}"{place}><{joint} name="uav{i}"{kind}/>{_inertial(uav.mass, uav.inertia)}'
        f'{ball}<site name="uav{i}"/></body>'
    )


def _inertial(mass: float, J: Array) -> str:
    full = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
    return f'<inertial pos="0 0 0" mass="{mass!r}" fullinertia="{_text(full)}"/>'


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
