"""Prediction over the horizon, affine in the decision v and time-invariant.

A free response and an impulse response.
"""

from dataclasses import dataclass

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.model.kernels import native
from transport.model.kernels.native import Places
from transport.model.linear.discretisation import Discrete
from transport.model.linear.linearisation import Linearisation
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.rollout import Rollout


class Linear(msgspec.Struct, frozen=True, kw_only=True):
    """Linearisation of one step and its steady-state input."""

    x0: Array  # state of the linearisation, (n,)
    z0: Array  # the same, with motor lag followed by the actual inputs, (n + m,)
    u0: Array  # input from which the inputs deviate, (m,)
    model: Linearisation
    u_target: Array  # input without cost, (m,)
    forces: Array | None = None  # estimated external forces, (3 + 3 N,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Prediction of one step; n counts the actual inputs of known motors.

    dx(k) = dX_free(k) + sum_{j < k} A^(k-1-j) B v(j),   u_own(k) = U_free(k) + v(k)
    """

    effect: Array  # A^j B, (n, N_p, m_own)
    dX_free: Array  # state deviations from x0 with v = 0 at steps 0..N_p, (N_p + 1, n)
    U_free: Array  # owned inputs with v = 0, (N_p, m_own)
    U_all: Array  # the inputs of all UAVs with v = 0, (N_p, m)
    feedback: Array  # K effect, with the gain of the law, (m, N_p, m_own); (0, ..) without law
    dU_free: Array  # K dX_free at steps 0..N_p-1, (N_p, m); (N_p, 0) without law


def predict(
    discrete: Discrete, u0: Array, own: Places, U: Array, law: FeedbackLaw | None = None
) -> Prediction:
    """Predict for owned inputs u0 + v, the others as announced, (N_p, m), or by the law.

    dx(k+1) = (A + B_q K_q) dx(k) + B_o v(k) + W(k), with W of the others' inputs at x0.
    Source: docs/equations.md (22)-(24), (35), (36).
    """
    n = len(discrete.A)
    at_x0 = U if law is None else law.uncorrected + law.c
    steps = len(at_x0)

    B_others = discrete.B.copy()
    B_others[:, own] = 0.0
    A = discrete.A if law is None else discrete.A + B_others @ law.K
    dX = free_response(A, discrete.f_d + (at_x0 - u0) @ B_others.T)

    # A^j B_o
    effect = np.empty((n, steps, len(own)))
    effect[:, 0] = discrete.B[:, own]
    for j in range(1, steps):
        effect[:, j] = A @ effect[:, j - 1]

    feedback = np.zeros((0, steps, len(own)))
    dU = np.zeros((steps, 0))
    U_all = at_x0.copy()
    if law is not None:
        feedback = np.tensordot(law.K, effect, 1)
        dU = dX[:-1] @ law.K.T
        U_all += dU

    U_free = np.repeat(u0[own][None], steps, axis=0)
    U_all[:, own] = U_free
    return Prediction(
        effect=effect, dX_free=dX, U_free=U_free, U_all=U_all, feedback=feedback, dU_free=dU
    )


def follow(
    prediction: Prediction, along: Rollout, by_own: Array, law: FeedbackLaw, u0: Array, own: Places
) -> None:
    """Make the free response of a prediction exact along a trajectory of the nonlinear model.

    dX_free(k) = x_bar(k) - x0 - sum_{j < k} (A + B_q K_q)^(k-1-j) B_o (u_bar_o(j) - u0_o)

    The last term, `by_own`, is the response to that trajectory's owned inputs, (N_p + 1, n).
    Source: docs/equations.md (35a).
    """
    prediction.dX_free[:] = along.Z - along.Z[0] - by_own
    prediction.dU_free[:] = prediction.dX_free[:-1] @ law.K.T
    prediction.U_all[:] = law.uncorrected + law.c + prediction.dU_free
    prediction.U_all[:, own] = u0[own]
    prediction.U_free[:] = u0[own]


def own_response(A: Array, B_own: Array, V: Array) -> Array:
    """Return the response, (N_p + 1, n), to deviations V of owned inputs, (N_p, m_own)."""
    drive = V @ B_own.T
    if not native.AVAILABLE:
        return free_response(A, drive)
    dX = np.empty((len(V) + 1, len(A)))
    native.KERNELS.free_response(len(V), len(A), *map(native.address, (A, drive, dX)))
    return dX


def convolve(effect: Array, v: Array) -> Array:
    """Return deviations of signals by decisions v, (N_p, m): (N_p, signals).

    s(k) = sum_{j < k} effect(k-1-j) v(j). Source: docs/equations.md (24).
    """
    signals = np.zeros((len(v), len(effect)))
    for k in range(1, len(v)):
        signals[k] = np.einsum("sjm,jm->s", effect[:, :k], v[:k][::-1])
    return signals


def free_response(A: Array, W: Array) -> Array:
    """Return the response from zero to a drive W, (N_p, n): states, (N_p + 1, n).

    dx(0) = 0, dx(k+1) = A dx(k) + W(k). Source: docs/equations.md (23); paper (15), (23).
    """
    dX = np.zeros((len(W) + 1, A.shape[0]))
    for k, w in enumerate(W):
        np.dot(A, dX[k], out=dX[k + 1])
        dX[k + 1] += w
    return dX


def stacked(effect: Array) -> Array:
    """Return the prediction matrix, (N_p s, N_p m): block (k, j) is effect(k - j), k >= j.

    Args:
        effect: Effect of a decision on the signals 1..N_p steps later, (s, N_p, m).
    Source: docs/equations.md (25).
    """
    s, steps, m = effect.shape
    matrix = np.zeros((steps, s, steps, m))
    for j in range(steps):
        matrix[j:, :, j] = effect[:, : steps - j].transpose(1, 0, 2)
    return matrix.reshape(steps * s, steps * m)
