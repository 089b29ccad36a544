"""Kalman filter of any linear system: prediction and correction of a covariance.

Docs/equations.md (63), (64), in general:

    xi(k+1) = A xi(k) + w,    cov(w) = Q
    z       = H xi + v,       cov(v) = diag(R)

The functions know nothing of the team, nor of the estimate itself: with an error-state filter the
caller moves its estimate by the step of the correction.
"""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """Measurements and their prediction by an estimate."""

    error: Array  # innovation z - h(x), (k,)
    H: Array  # derivative of h by the error coordinates xi, (k, r)
    R: Array  # variances of the sensors' noise, (k,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """Optimal correction by an observation."""

    step: Array  # xi, (r,)
    G: Array  # gain, (r, k)
    S: Array  # covariance of the innovation, (k, k)
    H_P: Array  # H P, (k, r)
    squared_error: float  # (z - h)' S^-1 (z - h): as large as the number of measurements on average


def predict(P: Array, A: Array, Q: Array) -> Array:
    """Return the covariance one step later, (r, r)."""
    #   P^- = A P A' + Q
    P = A @ P @ A.T + Q

    # Rounding must not make it asymmetric: errors of the asymmetric part grow.
    symmetric: Array = (P + P.T) / 2.0
    return symmetric


def correct(P: Array, observation: Observation) -> Correction:
    """Return the correction of least variance for a covariance, (r, r)."""
    H = observation.H
    error = observation.error

    #   S = H P H' + R
    H_P = H @ P
    S = H_P @ H.T + np.diag(observation.R)

    #   G' = S^-1 H P,    xi = G (z - h)
    solved = np.linalg.solve(S, np.column_stack([H_P, error]))
    G = np.asarray(solved[:, :-1].T, dtype=np.float64)
    squared_error = float(error @ solved[:, -1])
    return Correction(step=G @ error, G=G, S=S, H_P=H_P, squared_error=squared_error)


def corrected(P: Array, G: Array, observation: Observation) -> Array:
    """Return the covariance after a correction with any gain G, (r, k), in Joseph's form.

    It holds for gains that are not optimal, and rounding cannot make it indefinite.
    """
    #   P^+ = (I - G H) P (I - G H)' + G R G'
    kept = np.eye(len(P)) - G @ observation.H
    P = kept @ P @ kept.T + (G * observation.R) @ G.T

    symmetric: Array = (P + P.T) / 2.0
    return symmetric
