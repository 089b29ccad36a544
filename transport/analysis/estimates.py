"""What the Kalman filters of the agents know of the payload, compared with the plant's state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from agent.kalman import TOLD, understood
from model import state
from model.arrays import Array
from protocol.wire.messages import Note
from transport.analysis.series import Series
from transport.log.run_log import RunLog


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimates:
    """Estimates of the payload's pose (x, y, z, roll, pitch, yaw), m and rad, by all agents at some recorded ticks."""

    agents: npt.NDArray[np.intp]  # (k,), 1-based
    rows: npt.NDArray[np.intp]  # their ticks' rows in the series, (k,)
    pose: Array  # estimated, (k, 6)
    true: Array  # (k, 6)
    P: Array  # covariance of the error, (k, 6, 6)
    surprise: Array  # squared innovation of the newest measurements over its covariance, and their number, (k, 2)

    @property
    def deviations(self) -> Array:
        """Standard deviations, (k, 6)."""
        return np.sqrt(np.diagonal(self.P, axis1=1, axis2=2))


def estimates_of(series: Series, log: RunLog) -> Estimates | None:
    """Return the estimates in a log; None if there are none."""
    at = {int(tick): row for row, tick in enumerate(series.ticks)}
    notes = [note for note in log.of(Note) if note.names == TOLD and note.tick in at]
    if not notes:
        return None
    numbers, rows = np.array([note.values for note in notes]), np.array([at[note.tick] for note in notes])
    pose, P = understood(numbers)
    return Estimates(
        agents=np.array([note.agent for note in notes]),
        rows=rows,
        pose=pose,
        true=series.x[rows][:, np.r_[state.R0, state.THETA0]],
        P=P,
        surprise=numbers[:, -2:],
    )


def consistency(series: Series, log: RunLog) -> dict[str, Any] | None:
    """Return errors of the estimates and how they match their covariance, as JSON data; None without estimates.

    NEES and NIS are squared errors in units of the covariance (docs/equations.md, after (64)).
    """
    found = estimates_of(series, log)
    if found is None:
        return None
    error = found.true - found.pose
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(found.P, error[:, :, None])[:, :, 0])
    nis, measurements = found.surprise.sum(axis=0)
    low, high = chi2.ppf([0.025, 0.975], error.shape[1])
    rms = np.sqrt((error**2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0))
    return {
        "position_rms_m": float(rms[0]),
        "attitude_rms_deg": float(np.degrees(rms[1])),
        "nees": float(nees.mean()),
        "nees_band": [float(low), float(high)],
        "nis": float(nis / measurements) if measurements else None,
    }
