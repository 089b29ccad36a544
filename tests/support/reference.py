"""Reference accelerations and trajectories from physics engines, in the project's conventions.

The file stores attitudes as matrices and thrust along +b3 (down); the model takes Euler angles and
thrust along -b3 (lift). `tests/model/data/README.md` describes it.
"""

import json
import lzma
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import Payload, System, Uav
from transport.model.physics.rotations import euler_angles

_FILE = Path(__file__).parents[1] / "model" / "data" / "engines.json.xz"
_CASES: dict[str, dict[str, Any]] = json.loads(lzma.decompress(_FILE.read_bytes()))

ACCELERATIONS = sorted(name for name in _CASES if name.startswith("accel_"))
TRAJECTORIES = sorted(name for name in _CASES if name.startswith("traj_"))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationCase:
    """One state, one input, and the accelerations by the physics engines.

    Attributes:
        system: Physical parameters.
        x: State, (12 + 12 N,), SI.
        u: Input, (4 N,), SI.
        R0: Payload attitude as stored, (3, 3).
        expected: Derivatives, tensions, energy and momenta by name, as in the file's block
            `expected`.
    """

    system: System
    x: Array
    u: Array
    R0: Array
    expected: dict[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryCase:
    """A trajectory under piecewise constant input.

    Attributes:
        system: Physical parameters.
        period_s: Time between samples, s.
        x: States at the samples, (41, 12 + 12 N), SI.
        R0: Payload attitudes as stored, (41, 3, 3).
        R: UAV attitudes as stored, (41, N, 3, 3).
        u: Inputs held from sample to sample, (40, 4 N), SI; thrust 0 where `force_I` is given.
        force_I: UAV forces held in the inertial frame, (40, N, 3), N, or None when thrust turns
            with the UAV.
    """

    system: System
    period_s: float
    x: Array
    R0: Array
    R: Array
    u: Array
    force_I: Array | None


def acceleration(name: str) -> AccelerationCase:
    """Return one of ACCELERATIONS."""
    content = _CASES[name]
    return AccelerationCase(
        system=_system(content["params"]),
        x=_state(_arrays(content["state"])),
        u=_input(_arrays(content["input"])),
        R0=np.array(content["state"]["R0"]),
        expected=_arrays(content["expected"]),
    )


def trajectory(name: str) -> TrajectoryCase:
    """Return one of TRAJECTORIES."""
    content = _CASES[name]
    states, inputs = _arrays(content["states"]), _arrays(content["input"])
    return TrajectoryCase(
        system=_system(content["params"]),
        period_s=float(content["dt"]),
        x=_state(states),
        R0=states["R0"],
        R=states["R_i"],
        u=_input(inputs),
        force_I=inputs["thrust_inertial"] if content["input_mode"] == "force_vec" else None,
    )


def _arrays(block: dict[str, Any]) -> dict[str, Array]:
    return {name: np.array(value, dtype=np.float64) for name, value in block.items()}


def _system(params: dict[str, Any]) -> System:
    uavs = [
        Uav(mass=m, inertia=J, rho=rho, rod_length=length)
        for m, J, rho, length in zip(
            params["m"], params["J"], params["rho"], params["l"], strict=True
        )
    ]
    return System(
        payload=Payload(mass=params["m0"], inertia=params["J0"]), uavs=uavs, gravity=params["g"]
    )


def _state(fields: dict[str, Array]) -> Array:
    """Return the state vector of one sample, (n,), or of several, (k, n)."""
    payload = np.concatenate(
        [fields["r0"], fields["v0"], euler_angles(fields["R0"]), fields["omega0"]], axis=-1
    )
    uavs = np.concatenate(
        [fields["e"], fields["Omega"], euler_angles(fields["R_i"]), fields["omega_i"]], axis=-1
    )
    return np.concatenate([payload, uavs.reshape(*payload.shape[:-1], -1)], axis=-1)


def _input(fields: dict[str, Array]) -> Array:
    """Return the input vector of one sample, (m,), or of several, (k, m)."""
    tau = fields["tau_i"]
    thrust = -fields["f_i"] if "f_i" in fields else np.zeros(tau.shape[:-1])
    return np.concatenate([thrust[..., None], tau], axis=-1).reshape(*tau.shape[:-2], -1)
