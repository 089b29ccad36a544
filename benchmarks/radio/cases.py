"""Cases of the comparison: a team, its channel, and the instants at which it sends."""

import math
from dataclasses import dataclass, replace

import numpy as np

PERIOD_NS = 50_000_000
Position = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Stations that each send one message per period, spread over its first `scatter_s`."""

    name: str
    positions: tuple[Position, ...]
    rate_mbps: float
    scatter_s: float
    standard: str = "802.11a"
    unicast: bool = False  # to the next station
    message_bytes: int = 1500
    periods: int = 1000
    queue_length: int = 100
    attempts: int = 7
    power_dbm: float = 16.0
    exponent: float = 3.0
    reference_loss_db: float = 46.6777
    noise_figure_db: float = 7.0
    sensitivity_dbm: float = -82.0
    preamble_snr_db: float = 4.0
    carrier_sense_dbm: float = -82.0
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Send:
    """One message: instant, ns, sender, and receiver, -1 for all."""

    time_ns: int
    sender: int
    receiver: int


def sends(case: Case) -> list[Send]:
    """Return the sends of a case in the order of their instants."""
    stations = len(case.positions)
    random = np.random.default_rng(case.seed)
    spread_ns = random.uniform(0.0, case.scatter_s * 1e9, (case.periods, stations)).astype(int)
    instants_ns = spread_ns + PERIOD_NS * np.arange(1, case.periods + 1)[:, None]
    unsorted = [
        Send(
            int(instants_ns[period, station]),
            station,
            (station + 1) % stations if case.unicast else -1,
        )
        for period in range(case.periods)
        for station in range(stations)
    ]
    return sorted(unsorted, key=lambda send: (send.time_ns, send.sender))


def end_ns(case: Case) -> int:
    """Return the end of a case, ns: a second after the last period, in which queues run empty."""
    return PERIOD_NS * (case.periods + 1) + 1_000_000_000


def circle(stations: int, diameter_m: float) -> tuple[Position, ...]:
    """Return stations on a circle, at heights that differ by a few centimetres.

    No two distances are equal: equal powers are a case that occurs in no team.
    """
    radius = diameter_m / 2.0
    angles = [
        2.0 * math.pi * (station + 0.13 * math.sin(7.0 * station)) / stations
        for station in range(stations)
    ]
    return tuple(
        (radius * math.cos(angle), radius * math.sin(angle), 0.05 * station)
        for station, angle in enumerate(angles)
    )


def team(stations: int, rate_mbps: float, scatter_ms: float, diameter_m: float = 4.0) -> Case:
    """Return a team on a circle."""
    return Case(
        name=f"N = {stations}, {diameter_m:g} m, {rate_mbps:g} Mb/s, {scatter_ms:g} ms",
        positions=circle(stations, diameter_m),
        rate_mbps=rate_mbps,
        scatter_s=scatter_ms / 1e3,
        periods=1000 if stations <= 8 else 400,
    )


def hidden(scatter_ms: float) -> Case:
    """Return two stations that do not hear each other, and one between them that hears both."""
    return Case(
        name=f"hidden node, 6 Mb/s, {scatter_ms:g} ms",
        positions=((-40.0, 0.0, 0.0), (0.0, 1.0, 0.0), (40.5, 0.0, 0.0)),
        rate_mbps=6.0,
        scatter_s=scatter_ms / 1e3,
    )


def with_unicast(case: Case) -> Case:
    """Return a case with acknowledged messages."""
    return replace(case, name=f"{case.name}, unicast", unicast=True)


def with_dsss(case: Case) -> Case:
    """Return a case with 802.11b at 2.4 GHz and shorter messages."""
    return replace(
        case,
        name=f"{case.name}, 802.11b",
        standard="802.11b",
        message_bytes=500,
        reference_loss_db=40.0,
    )


SCATTERS_MS = (0.0, 0.1, 1.0, 5.0, 40.0)
SIZES = (2, 4, 8, 16, 30)


def cases() -> list[Case]:
    """Return all cases of the comparison."""
    return [
        *[team(n, rate, scatter) for n in SIZES for rate in (6.0, 24.0) for scatter in SCATTERS_MS],
        *[team(4, rate, 1.0, d) for d in (25.0, 50.0, 55.0, 75.0, 100.0) for rate in (6.0, 24.0)],
        *[team(16, rate, 5.0, d) for d in (50.0, 75.0, 100.0, 150.0) for rate in (6.0, 24.0)],
        *[hidden(scatter) for scatter in SCATTERS_MS],
        *[with_unicast(team(n, 6.0, scatter)) for n in (4, 16) for scatter in SCATTERS_MS],
        *[with_unicast(team(8, 24.0, scatter)) for scatter in SCATTERS_MS],
        *[with_dsss(team(4, rate, scatter)) for rate in (1.0, 11.0) for scatter in SCATTERS_MS],
        *[team(4, 54.0, 1.0, d) for d in (4.0, 25.0, 35.0)],
    ]
