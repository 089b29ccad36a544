"""Prediction over the horizon, affine in the decision v and time-invariant.

A free response and an impulse response.
"""

from dataclasses import dataclass

import numpy as np

from transport.model import native
from transport.model.arrays import Array
from transport.model.discretisation import Discrete
from transport.model.linearisation import Linearisation
from transport.model.native import Places
from transport.mpc.feedback import FeedbackLaw


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Linearisation of one step and its steady-state input."""

    x0: Array  # state of the linearisation, (n,)
    z0: Array  # the same, with motor lag followed by the actual inputs, (n + m,)
    u0: Array  # input from which the inputs deviate, (m,)
    model: Linearisation
    u_target: Array  # input without cost, (m,)
    forces: Array | None = None  # estimated external forces, (3 + 3 N,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """dx(k) = dX_free(k) + sum_{j < k} A^(k-1-j) B v(j), u_own(k) = U_free(k) + v(k).

    N counts known motors.
    """

    effect: Array  # A^j B, (n, N_p, m_own)
    dX_free: Array  # state deviations from x0 with v = 0 at steps 0..N_p, (N_p + 1, n)
    U_free: Array  # owned inputs with v = 0, (N_p, m_own)
    U_all: Array  # the inputs of all UAVs with v = 0, (N_p, m)
    feedback: Array  # K effect, (m, N_p, m_own), with the gain of the shared control law; (0, N_p, m_own) without
    dU_free: Array  # K dX_free at steps 0..N_p-1, (N_p, m); (N_p, 0) without


def predict(
    discrete: Discrete, u0: Array, own: Places, U: Array, law: FeedbackLaw | None = None
) -> Prediction:
    """Predict for owned inputs u0 + v, the others as announced, (N_p, m), or by the law.

    (22)-(24), (35).
    """
    at_x0 = U if law is None else law.uncorrected + law.c
    (n, _), steps, B_others = discrete.B.shape, len(at_x0), discrete.B.copy()
    B_others[:, own] = 0.0
    A = discrete.A if law is None else discrete.A + B_others @ law.K
    dX = free_response(A, discrete.f_d + (at_x0 - u0) @ B_others.T)
    effect = np.empty((n, steps, len(own)))
    effect[:, 0] = discrete.B[:, own]
    for j in range(1, steps):
        effect[:, j] = A @ effect[:, j - 1]
    feedback, dU, U_all = np.zeros((0, steps, len(own))), np.zeros((steps, 0)), at_x0.copy()
    if law is not None:
        feedback, dU = np.tensordot(law.K, effect, 1), dX[:-1] @ law.K.T
        U_all += dU
    U_all[:, own] = U_free = np.repeat(u0[own][None], steps, axis=0)
    return Prediction(
        effect=effect, dX_free=dX, U_free=U_free, U_all=U_all, feedback=feedback, dU_free=dU
    )


def follow(
    prediction: Prediction,
    A: Array,
    B: Array,
    u0: Array,
    own: Places,
    law: FeedbackLaw,
    Z: Array,
    U: Array,
) -> None:
    """Make the free response exact along states Z, (N_p + 1, n), of inputs U.

    A: with the others' feedback: (35a).
    """
    V = U[:, own] - u0[own]
    drive, caused = V @ B[:, own].T, np.empty(Z.shape)
    if native.AVAILABLE:
        native.KERNELS.free_response(len(V), len(A), *map(native.at, (A, drive, caused)))
    else:
        caused = free_response(A, drive)
    prediction.dX_free[:] = Z - Z[0] - caused
    prediction.dU_free[:] = prediction.dX_free[:-1] @ law.K.T
    prediction.U_all[:] = law.uncorrected + law.c + prediction.dU_free
    prediction.U_all[:, own] = prediction.U_free[:] = u0[own]


def convolve(effect: Array, v: Array) -> Array:
    """Return deviations of signals by decisions v.

    Sum_{j < k} effect(k-1-j) v(j), (N_p, signals). Source: (24).
    """
    found = np.zeros((len(v), len(effect)))
    for k in range(1, len(v)):
        found[k] = np.einsum("sjm,jm->s", effect[:, :k], v[:k][::-1])
    return found


def free_response(A: Array, W: Array) -> Array:
    """Return dx(0) = 0, dx(k+1) = A dx(k) + W(k), (N_p + 1, n), to a drive W, (N_p, n).

    (23); paper (15), (23).
    """
    dX = np.zeros((len(W) + 1, A.shape[0]))
    for k, w in enumerate(W):
        np.dot(A, dX[k], out=dX[k + 1])
        dX[k + 1] += w
    return dX


def stacked(effect: Array) -> Array:
    """Return the prediction matrix of signals, (N_p s, N_p m), by the effect of a decision, (s, N_p, m): (25)."""
    s, steps, m = effect.shape
    matrix = np.zeros((steps, s, steps, m))
    for j in range(steps):
        matrix[j:, :, j] = effect[:, : steps - j].transpose(1, 0, 2)
    return matrix.reshape(steps * s, steps * m)
