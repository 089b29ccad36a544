"""Payload swing at the end of a run: its size, and whether it dies out (docs/summary.md)."""

import math
from dataclasses import dataclass

import numpy as np

from model.maneuver import Maneuver, Phase
from protocol.scenario.setup import Setup
from transport.analysis.series import Series

# End of the run in which the swing is measured, s: longer than the 3.6 s period of a pendulum of 3.2 m, and shorter
# than the last hover of the paper's maneuver, 5 s.
SWING_S = 4.0

# A smaller swing counts as at rest, m.
AT_REST_M = 0.01

# A swing dies out if its amplitude falls at least to this share from one window to the next: by half in about 60 s on
# rods of 3.2 m. Any damping ratio above 0.0065 is enough: exp(-0.0065 pi) = 0.98. Sampling at 50 ms changes a
# sustained swing by 0.1 % at most.
DECAYING = 0.98

# Rounding of times, in sampling periods.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Swing:
    """Payload swing at the end of a run."""

    largest_m: float | None  # largest payload position error in the last `SWING_S`, m; None without a recorded tick
    decays: bool | None  # whether the swing dies out or is at rest; None where the run does not tell


def swing_of(setup: Setup, series: Series) -> Swing:
    """Measure the payload swing at the end of a run."""
    if not len(series.ticks):
        return Swing(largest_m=None, decays=None)
    begin = int(series.ticks[-1]) + 1 - _periods(setup, SWING_S)
    errors_m = np.linalg.norm(series.payload_error_I[series.ticks >= begin], axis=1)
    return Swing(largest_m=float(errors_m.max()), decays=_decays(setup, series))


def _decays(setup: Setup, series: Series) -> bool | None:
    """Compare the amplitude of the swing in two consecutive windows at the end of the run.

    The amplitude is the largest horizontal speed of the payload, divided by the angular frequency sqrt(g / l) of a
    pendulum as long as the longest rod. Unlike the position error, the speed does not contain a constant offset such
    as the lean of the rods in wind. It repeats every half period pi sqrt(l / g), and no window is shorter. So the
    windows of a sustained swing have equal amplitudes at any phase, and a damping sigma gives a ratio of at most
    exp(-sigma pi sqrt(l / g)).

    Returns: None unless both windows are recorded without a gap, inside the hold at the end of the maneuver.
    """
    per_omega_s = math.sqrt(max(uav.rod_length for uav in setup.system.uavs) / setup.system.gravity)
    window = _periods(setup, max(SWING_S / 2.0, math.pi * per_omega_s))
    begin = int(series.ticks[-1]) + 1 - 2 * window
    held_from = _hold_begin_s(setup.maneuver) / setup.settings.sampling_period_s
    last = series.ticks >= begin
    if begin < held_from - _ROUNDING or np.count_nonzero(last) != 2 * window:
        return None
    speeds_mps = np.linalg.norm(series.payload_velocity_I[last, :2], axis=1)
    before_m, after_m = (per_omega_s * float(part.max()) for part in np.split(speeds_mps, 2))
    return after_m <= max(AT_REST_M, DECAYING * before_m)


def _periods(setup: Setup, duration_s: float) -> int:
    """Return the number of sampling periods that cover a duration."""
    return math.ceil(duration_s / setup.settings.sampling_period_s - _ROUNDING)


def _hold_begin_s(maneuver: Maneuver) -> float:
    """Return the time from which on the reference is at rest until the end of the maneuver, s."""
    if maneuver.targets:
        return maneuver.targets[-1].ends_s
    begin_s = maneuver.duration_s
    for phase in reversed(maneuver.phases):
        if not _is_hold(phase):
            break
        begin_s -= phase.duration_s
    return begin_s


def _is_hold(phase: Phase) -> bool:
    """Return whether the reference does not move during a phase."""
    return not phase.displacement_I.any() and (phase.way is None or not phase.way[:, 1:].any())
