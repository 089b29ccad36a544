"""Prediction over the horizon: the free response with held owned inputs, and the effect of each owned input.

A prediction is affine in the decision v (one row per step) and time-invariant over the horizon, so the free response
and one impulse response describe it fully.
"""

from dataclasses import dataclass

import numpy as np

from model import native
from model.arrays import Array
from model.discretisation import Discrete
from model.linearisation import Linearisation
from mpc.feedback import FeedbackLaw


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Linearisation of one step and its steady-state input.

    Attributes:
        x0: State of the linearisation, (n,).
        u0: Input of the linearisation, (m,).
        model: f, A_c, B_c, y, C.
        u_target: Input without cost, (m,).
    """

    x0: Array
    u0: Array
    model: Linearisation
    u_target: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """The states and inputs over the horizon as affine functions of the decision v.

        dx(k) = dX_free(k) + sum_{j < k} A^(k-1-j) B v(j),    u_own(k) = U_free(k) + v(k)

    Attributes:
        A: State matrix of the prediction, (n, n).
        B: Effect of the decision, (n, m_own).
        impulse: A^j B, (N_p, n, m_own).
        dX_free: State deviations from x0 with v = 0 at steps 0..N_p, (N_p + 1, n).
        U_free: Owned inputs with v = 0, (N_p, m_own).
        W: Drive per step with v = 0, dX_free(k+1) = A dX_free(k) + W(k), (N_p, n).
        U_others: The others' inputs with v = 0, (N_p, m - m_own).
    """

    A: Array
    B: Array
    impulse: Array
    dX_free: Array
    U_free: Array
    W: Array
    U_others: Array


def open_loop(discrete: Discrete, u0: Array, own: np.ndarray, others: np.ndarray, U: Array) -> Prediction:
    """Predict with the owned inputs held at u0 and the others' inputs as announced, as in the paper.

    Args:
        discrete: Zero-order hold about (x0, u0).
        u0: Input of the linearisation, (m,).
        own: Positions of the owned inputs in u, (m_own,).
        others: Positions of all other inputs, (m - m_own,).
        U: Announced inputs of all UAVs over the horizon, (N_p, m); owned columns are not read.
    Returns: Prediction whose decision is the deviation of the owned inputs from u0.
    Source: docs/equations.md (22)-(24); paper (22)-(24), with B_i in (23) and delta X in (24).
    """
    dU = U - u0
    dU[:, own] = 0.0
    W = discrete.f_d + dU @ discrete.B.T
    B = np.ascontiguousarray(discrete.B[:, own])
    impulse, dX = responses(discrete.A, B, W)
    U_free = np.repeat(u0[own][None], len(U), axis=0)
    return Prediction(A=discrete.A, B=B, impulse=impulse, dX_free=dX, U_free=U_free, W=W, U_others=U[:, others])


def closed_loop(discrete: Discrete, u0: Array, own: np.ndarray, others: np.ndarray, law: FeedbackLaw) -> Prediction:
    """Predict with the owned inputs held at u0 and the others' inputs by the shared control law.

    Input of UAV j: u_rest + K_j (x - x_ref) + c_j.

    The prediction includes the others' feedback, so an agent does not correct an error that they already correct.

    The control law covers the horizon and has the announced corrections; the rest as in `open_loop`.
    Source: docs/equations.md (35)-(36).
    """
    B, B_others = np.ascontiguousarray(discrete.B[:, own]), discrete.B[:, others]
    K = law.K[others]
    A = discrete.A + B_others @ K
    at_x0 = law.inputs(others)
    W = discrete.f_d + (at_x0 - u0[others]) @ B_others.T
    impulse, dX = responses(A, B, W)
    U_free, U_others = np.repeat(u0[own][None], len(W), axis=0), at_x0 + dX[:-1] @ K.T
    return Prediction(A=A, B=B, impulse=impulse, dX_free=dX, U_free=U_free, W=W, U_others=U_others)


def free_response(A: Array, W: Array) -> Array:
    """Return the response from zero to a drive W, (N_p, n): dx(0) = 0, dx(k+1) = A dx(k) + W(k), (N_p + 1, n).

    Source: docs/equations.md (23); paper (15), (23).
    """
    if native.AVAILABLE:
        return native.free_response(np.ascontiguousarray(A), np.ascontiguousarray(W))
    dX = np.zeros((len(W) + 1, A.shape[0]))
    for k, w in enumerate(W):
        dX[k + 1] = A @ dX[k] + w
    return dX


def responses(A: Array, B: Array, W: Array) -> tuple[Array, Array]:
    """Return impulse response A^j B and free response; one matrix product per step serves both.

    A (n, n), B (n, m), drive per step W (N_p, n).

    Returns: A^j B for j = 0..N_p-1, (N_p, n, m), the first block column of H in paper (16); dx at steps
        0..N_p as in `free_response`, (N_p + 1, n).
    Source: docs/equations.md (23)-(24); paper (15)-(16).
    """
    if native.AVAILABLE:
        return native.responses(np.ascontiguousarray(A), np.ascontiguousarray(B), W)
    return _responses(A, B, W)


def _responses(A: Array, B: Array, W: Array) -> tuple[Array, Array]:
    steps, (n, m) = len(W), B.shape
    columns = np.empty((steps + 1, n, m + 1))  # at step k: A^k B, and dx(k)
    columns[0, :, :m] = B
    columns[0, :, m] = 0.0
    for k in range(steps):
        np.matmul(A, columns[k], out=columns[k + 1])
        columns[k + 1, :, m] += W[k]
    return np.ascontiguousarray(columns[:-1, :, :m]), np.ascontiguousarray(columns[:, :, m])
