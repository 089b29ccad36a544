"""Estimates of the payload's pose by the agents' Kalman filters, beside the true pose, and their consistency."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.estimate_notes import NAMES, poses
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import Note

# Probabilities at the ends of the band in which a single NEES of a consistent filter lies. There is
# none for the mean: values of successive ticks and of several agents are correlated.
_BAND = (0.025, 0.975)


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimates:
    """Estimates of the payload's pose by all agents, k of them at some recorded ticks.

    A pose is x, y, z, roll, pitch, yaw, m and rad.
    """

    agents: npt.NDArray[np.intp]  # (k,), 1-based
    rows: npt.NDArray[np.intp]  # their ticks' rows in the series, (k,)
    pose: Array  # estimated, (k, 6)
    true: Array  # (k, 6)
    P: Array  # covariance of the error, (k, 6, 6)
    squared_innovation: Array  # of the newest measurements, nu^T S^-1 nu, (k,)
    measurements: Array  # their number, (k,)


def estimates_of(series: Series, log: RunLog) -> Estimates | None:
    """Return the estimates in a log; None if there are none."""
    row_of_tick = series.row_of_tick
    notes = [note for note in log.of(Note) if note.names == NAMES and note.tick in row_of_tick]
    if not notes:
        return None

    values = np.array([note.values for note in notes])
    rows = np.array([row_of_tick[note.tick] for note in notes])
    pose, P = poses(values)
    true = series.x[rows][:, np.r_[state.R0, state.THETA0]]
    return Estimates(
        agents=np.array([note.agent for note in notes]),
        rows=rows,
        pose=pose,
        true=true,
        P=P,
        squared_innovation=values[:, NAMES.index("surprise")],
        measurements=values[:, NAMES.index("measurements")],
    )


def consistency(series: Series, log: RunLog) -> dict[str, Any] | None:
    """Return errors of the estimates and how they match their covariance, as JSON data.

    NEES and NIS are squared errors in units of the covariance (docs/equations.md, after (64)).
    None without estimates.
    """
    estimates = estimates_of(series, log)
    if estimates is None:
        return None
    from scipy.special import gammaincinv  # 0.1 s of a run, most of which have no covariance

    # NEES = e^T P^-1 e, with the error e = true - estimated.
    error = estimates.true - estimates.pose
    weighted = np.linalg.solve(estimates.P, error[:, :, None])[:, :, 0]
    nees = np.einsum("ki,ki->k", error, weighted)
    # Chi-square with n degrees of freedom:  P(nees <= b) = gammainc(n / 2, b / 2).
    band = 2.0 * gammaincinv(error.shape[1] / 2, _BAND)

    # NIS = sum nu^T S^-1 nu / number of measurements, with the innovations nu of (64).
    measurements = estimates.measurements.sum()
    nis = estimates.squared_innovation.sum() / measurements if measurements else None
    squares = (error**2).reshape(-1, 2, 3).sum(axis=2)
    position_m, attitude_rad = np.sqrt(squares.mean(axis=0))
    return {
        "position_rms_m": float(position_m),
        "attitude_rms_deg": float(np.degrees(attitude_rad)),
        "nees": float(nees.mean()),
        "nees_band": band.tolist(),
        "nis": None if nis is None else float(nis),
    }
