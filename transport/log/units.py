"""Names of the entries of states and inputs, each ending in its unit, in the order of `model.state`."""

# Payload: position in the inertial frame (z down), velocity in the payload frame, attitude, angular velocity.
PAYLOAD_NAMES = (
    *("r0_x_m", "r0_y_m", "r0_z_m"),
    *("v0_x_m_s", "v0_y_m_s", "v0_z_m_s"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
    *("omega0_x_rad_s", "omega0_y_rad_s", "omega0_z_rad_s"),
)
# Each UAV: direction of its rod and the rod's rate in the payload frame, attitude, angular velocity.
UAV_STATE_NAMES = (
    *("e_x", "e_y", "e_z"),
    *("Omega_x_rad_s", "Omega_y_rad_s", "Omega_z_rad_s"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
    *("omega_x_rad_s", "omega_y_rad_s", "omega_z_rad_s"),
)
INPUT_NAMES = ("thrust_N", "moment_x_Nm", "moment_y_Nm", "moment_z_Nm")

# Endings of names and the units they stand for, longest first.
_UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_Nm": "N m", "_rad": "rad", "_N": "N", "_m": "m"}


def split_unit(name: str) -> tuple[str, str]:
    """Return a readable name and its unit, empty for none: "moment x" and "N m" for "moment_x_Nm"."""
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " "), unit
    return name.replace("_", " "), ""
