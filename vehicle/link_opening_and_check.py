"""Opening of the link to an autopilot, and its check alone."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from transport.mpc.settings_period_horizon_weights import Limits
from transport.protocol.network.mavlink import Endpoint, LinkError, MavlinkLink, read_key
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.wire.errors_and_exit_codes import EXIT_CHECK_FAILED
from transport.vehicle.ardupilot_and_px4 import DIALECTS
from transport.vehicle.autopilot import Autopilot
from transport.vehicle.betaflight_driver import BetaflightAutopilot, BetaflightSettings
from transport.vehicle.mavlink_driver import MavlinkAutopilot, MavlinkSettings
from transport.vehicle.msp import MspLink

# Time that an autopilot has to answer all questions, and between two looks at it, s.
_CHECK_S = 10.0
_LOOK_S = 0.05
_OWN = (255, 191)  # system of a ground station, component of an onboard computer
_BETAFLIGHT = "betaflight"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """Options of `transport vehicle` about its autopilot, as given."""

    link: str
    autopilot: str | None = None
    pose: str | None = None
    key: Path | None = None


def open_autopilot(
    vehicles: VehiclesSection,
    limits: Limits,
    uav: int,
    links: LinkOptions,
) -> Autopilot:
    """Return the driver of the autopilot of a UAV, 1-based, on its open links.

    `limits` are those of the controller, whose largest thrust counts where the section has none.
    Raises: LinkError.
    """
    name = links.autopilot or vehicles.autopilot
    thrust_N = vehicles.thrust_N or limits.thrust_N[1]
    if name == _BETAFLIGHT:
        return _open_betaflight(vehicles, thrust_N, limits.rates_rads, uav, links)
    if name not in DIALECTS:
        known = ", ".join((*DIALECTS, _BETAFLIGHT))
        raise LinkError(f"--autopilot: expected one of {known}, got {name!r}")
    if links.pose is not None:
        raise LinkError(f"--pose: expected none with {name}, which has an estimate of its own")
    key = None if links.key is None else read_key(links.key)
    opened = MavlinkLink(Endpoint.of(links.link), _OWN, uav, key)
    settings = MavlinkSettings(
        system=uav,
        thrust_N=thrust_N,
        origin=vehicles.origin,
        parameters=vehicles.parameters,
        stream_hz=2.0 * vehicles.setpoint_hz,
    )
    return MavlinkAutopilot(opened, DIALECTS[name](vehicles.setpoint_timeout_s), settings)


def _open_betaflight(
    vehicles: VehiclesSection,
    thrust_N: float,
    rates_rads: Sequence[float],
    uav: int,
    links: LinkOptions,
) -> BetaflightAutopilot:
    """Return the driver of a Betaflight, with its motion capture. Raises: LinkError."""
    if links.pose is None:
        raise LinkError(
            "--pose: expected an endpoint of the motion capture with betaflight, got none"
        )
    key = None if links.key is None else read_key(links.key)
    settings = BetaflightSettings(
        thrust_N=thrust_N,
        rates_rads=rates_rads,
        setpoint_timeout_s=vehicles.setpoint_timeout_s,
    )
    pose = MavlinkLink(Endpoint.of(links.pose, "--pose"), _OWN, uav, key)
    return BetaflightAutopilot(MspLink(links.link), pose, settings)


def check_autopilot(driver: Autopilot, say: Callable[[str], object]) -> int:
    """Print the checks of an autopilot, once all are answered or the time is over.

    Returns: The exit code: 0 if all are met.
    """
    end_s = time.monotonic() + _CHECK_S
    while time.monotonic() < end_s:
        driver.attend(time.monotonic_ns())
        told = driver.state()
        has_all = all(finding.got for finding in driver.findings())
        if told is not None and told.sensed is not None and told.is_healthy and has_all:
            break
        time.sleep(_LOOK_S)

    told = driver.state()
    if told is None:
        say(f"failed   {driver.silence()}")
        return EXIT_CHECK_FAILED
    rows = [(finding.is_met, str(finding)) for finding in driver.findings()]
    is_valid = told.sensed is not None and told.is_healthy
    rows.append((is_valid, f"estimate: {'valid' if is_valid else 'not valid'} {told.says}".strip()))
    battery = "not known" if told.battery < 0.0 else f"{told.battery:.0%}"
    rows.append((True, f"battery: {battery}; mode {told.mode}, armed: {told.armed}"))
    for is_met, text in rows:
        say(f"{'ok' if is_met else 'failed':8} {text}")
    return 0 if all(is_met for is_met, _ in rows) else EXIT_CHECK_FAILED
