"""Innovations of a filter: measurements against their prediction, with variances and derivatives, (64)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.filter.filter_interface import Sensed
from transport.agent.estimation.filter.kalman import Observation
from transport.agent.estimation.filter.unknown_forces import COUNT, Situation, UnknownForces
from transport.model import state
from transport.model.arrays import Array

# Normalised innovation squared (NIS) per measurement beyond which measurements deny an estimate.
# Gusts and masses that the model does not know stay below 15.
_LARGEST_NIS = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Entries:
    """Places of measurements, (k,) each."""

    within: npt.NDArray[np.intp]  # in the measurements of one UAV, 0 .. 14
    all: npt.NDArray[np.intp]  # in those of all UAVs, 0 .. 15 N - 1
    source: npt.NDArray[np.intp]  # index of the `Sensed` with the measurement
    angles: npt.NDArray[np.intp]  # indices of attitudes among the k measurements


@dataclass(frozen=True, slots=True, kw_only=True)
class Innovation:
    """Measurements of a tick against their prediction by an estimate."""

    place: Situation
    entries: Entries
    uavs: tuple[int, ...]  # sources of the measurements, 0-based
    error: Array  # z - h(x), (k,)
    R: Array  # variances of the sensors, (k,)


def innovation_of(sensed: Sequence[Sensed], place: Situation, variances: Array) -> Innovation:
    """Return the innovation z - h(x) of measurements at a place.

    variances: Of the sensors of a UAV, (15,).
    """
    entries = _entries(tuple((one.uav, one.sensors) for one in sensed))
    values = np.array([one.values for one in sensed])

    z = values[entries.source, entries.within]
    h = place.model.sensed(place.x, place.actual, forces=place.forces)[entries.all]
    error = z - h
    error[entries.angles] -= 2.0 * np.pi * np.round(error[entries.angles] / (2.0 * np.pi))
    return Innovation(
        place=place,
        entries=entries,
        uavs=tuple(one.uav for one in sensed),
        error=error,
        R=variances[entries.within],
    )


def observation_of(
    innovation: Innovation, T: Array, unknown_forces: UnknownForces | None
) -> Observation:
    """Return an innovation with the derivative H = dh/dxi of its measurements.

    T: Tangent directions of the coordinates, without those of unknown forces, (n, s).
    """
    place = innovation.place
    rows = innovation.entries.all
    n = len(place.x)
    s = T.shape[1]

    #   H = [ dh/dx T,  dh/dF dF/d unknowns ]
    _, slopes = place.model.sense(place.x, place.actual, forces=place.forces)
    unknowns = 0 if unknown_forces is None else COUNT
    H = np.empty((len(rows), s + unknowns))
    H[:, :s] = slopes[rows, :n] @ T[:n]
    if unknown_forces is not None:
        H[:, s:] = slopes[rows, n:] @ unknown_forces.derivative(place)
    return Observation(error=innovation.error, H=H, R=innovation.R)


def deny_the_estimate(squared_error: float, measurements: int) -> bool:
    """Return whether the innovations of a tick are too large for a correction: a new start is due.

    Args:
        squared_error: (z - h)' S^-1 (z - h), which is the number of measurements on average.
        measurements: Their number.
    """
    return squared_error > _LARGEST_NIS * measurements


@lru_cache  # one set of measurements is that of nearly all ticks
def _entries(sensed: tuple[tuple[int, tuple[int, ...]], ...]) -> Entries:
    """Return the places of measurements, from UAV and sensors of each source."""
    places = [
        (3 * sensor + axis, uav, source)
        for source, (uav, sensors) in enumerate(sensed)
        for sensor, axis in product(sensors, range(3))
    ]
    within, uavs, source = np.array(places, dtype=np.intp).T
    is_angle = (within >= state.THETA.start) & (within < state.THETA.stop)
    return Entries(
        within=within,
        all=within + state.SENSED * uavs,
        source=source,
        angles=np.flatnonzero(is_angle),
    )
