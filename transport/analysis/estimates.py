"""Estimates of the payload's pose by the agents' Kalman filters, beside the true pose."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.filter.belief import NAMES, poses
from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import Note


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
