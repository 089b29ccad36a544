"""The compiled loops of `kernels.c`: a controller's step is a hundred small matrix operations, mostly call overhead.

Without a C compiler `AVAILABLE` is false and Python functions with the same result, but for rounding, take their place.
"""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model import compiler, state
from model.arrays import Array

_FLAGS = ("-O3", "-march=native", "-fno-math-errno")

_address, _number, _double = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double
_SIGNATURES: dict[str, tuple[Any, Sequence[Any]]] = {
    "along_manifold": (None, [_number] * 3 + [_address] * 2),
    "zero_order_hold_work": (_number, [_number] * 2),
    "zero_order_hold": (_double, [_number] * 2 + [_address] * 3 + [_double] * 4 + [_address] * 4),
    "responses_work": (_number, [_number] * 2),
    "responses": (None, [_number] * 3 + [_address] * 6),
    "free_response": (None, [_number] * 2 + [_address] * 3),
    "condense_work": (_number, [_number] * 3),
    "condense": (None, [_number] * 3 + [_address] * 2 + [_double] + [_address] * 2 + [_number] + [_address] * 2),
    "toeplitz": (None, [_number] * 3 + [_address] * 2 + [_number]),
    "within_bounds_work": (_number, [_number]),
    "within_bounds": (ctypes.c_int, [_number] + [_address] * 4 + [ctypes.c_int] + [_address] * 3),
    "residuals": (None, [_number] * 2 + [_address] * 12),
}


def along_manifold(A_c: Array, x: Array) -> None:
    """See `model.linearisation.along_manifold`."""
    _KERNELS.along_manifold(len(x), state.PAYLOAD, state.PER_UAV, _at(x), _at(A_c.T))


def zero_order_hold(
    A_c: Array, B_c: Array, f: Array, period_s: float, theta_max: float, theta_possible: float, remainder: float
) -> tuple[float, Array, Array, Array]:
    """Return the growth theta, A, B and f_d; the last three are meaningless if theta > theta_possible or nan.

    Arguments as in `model.discretisation`; the period is halved above theta_max.
    """
    n, m = B_c.shape
    # Column-major, as CasADi returns them: no copies.
    columns, inputs = np.ascontiguousarray(A_c.T), np.ascontiguousarray(B_c.T)
    A, B, f_d = np.empty((n, n)), np.empty((n, m)), np.empty(n)
    theta = _KERNELS.zero_order_hold(
        n, m, _at(columns), _at(inputs), _at(f), period_s, theta_max, theta_possible, remainder,
        _at(A), _at(B), _at(f_d), _work("zero_order_hold_work", n, m),
    )  # fmt: skip
    return theta, A, B, f_d


def responses(A: Array, B: Array, W: Array) -> tuple[Array, Array]:
    """See `mpc.prediction.responses`."""
    steps, (n, m) = len(W), B.shape
    impulse, dX = np.empty((steps, n, m)), np.empty((steps + 1, n))
    _KERNELS.responses(
        steps, n, m, _at(A), _at(B), _at(W), _at(impulse), _at(dX), _work("responses_work", n, m)
    )  # fmt: skip
    return impulse, dX


def free_response(A: Array, W: Array) -> Array:
    """See `mpc.prediction.free_response`."""
    steps, n = W.shape
    dX = np.empty((steps + 1, n))
    _KERNELS.free_response(steps, n, _at(A), _at(W), _at(dX))
    return dX


def condense(output_impulse: Array, Q: Array, terminal: float, weighted: Array, H: Array, g: Array) -> None:
    """See `mpc.condensing.condense`."""
    steps, p, m = output_impulse.shape
    _KERNELS.condense(
        steps, p, m, _at(output_impulse), _at(Q), terminal, _at(weighted), _at(H), H.shape[1], _at(g),
        _work("condense_work", steps, p, m),
    )  # fmt: skip


def toeplitz(impulse: Array, rows: Array) -> None:
    """See `mpc.condensing.fill`."""
    steps, s, m = impulse.shape
    _KERNELS.toeplitz(steps, s, m, _at(impulse), _at(rows), rows.shape[1])


def within_bounds(H: Array, g: Array, lower: Array, upper: Array, most: int) -> tuple[int, Array, Array]:
    """Return number of guesses (0: failed), solution and multipliers; see `mpc.bounded.solve`."""
    n = len(g)
    z, multipliers = np.empty(n), np.empty(n)
    guesses = _KERNELS.within_bounds(
        n, _at(H), _at(g), _at(lower), _at(upper), most, _at(z), _at(multipliers), _work("within_bounds_work", n)
    )  # fmt: skip
    return guesses, z, multipliers


def residuals(
    H: Array, g: Array, lower: Array, upper: Array, A: Array, row_lower: Array, row_upper: Array,
    z: Array, bound_multipliers: Array, row_multipliers: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """See `mpc.qp.residuals`: stationarity, primal, complementarity."""
    found = (ctypes.c_double * 3)()
    n, rows = len(g), len(A)
    work = np.empty(n)
    _KERNELS.residuals(
        n, rows, _at(H), _at(g), _at(lower), _at(upper), _at(A), _at(row_lower), _at(row_upper), _at(z),
        _at(bound_multipliers), _at(row_multipliers), ctypes.addressof(found), _at(work),
    )  # fmt: skip
    return found[0], found[1], found[2]


def _at(array: Array) -> int:
    """Return the address of a row-major float64 array, 0 for an empty one."""
    if array.size == 0:
        return 0
    if array.dtype.char != "d" or not array.flags.c_contiguous:
        raise TypeError(f"expected a row-major array of float64, got {array.dtype} with strides {array.strides}")
    if array.flags.writeable:
        return ctypes.addressof(ctypes.c_double.from_buffer(array.data))  # fastest
    return int(array.ctypes.data)


def _work(which: str, *sizes: int) -> int:
    """Return the address of a kernel's work space, shared by all its calls: kernels hold the interpreter lock."""
    found = _WORK.get((which, sizes))
    if found is None:
        room = np.zeros(getattr(_KERNELS, which)(*sizes) + 8)
        # Aligned to the widest vectors.
        room = room[(-room.ctypes.data // 8) % 8 :]
        found = _WORK[which, sizes] = room, int(room.ctypes.data)
    return found[1]


# By kernel and sizes; never freed, as addresses do not keep the arrays alive.
_WORK: dict[tuple[str, tuple[int, ...]], tuple[Array, int]] = {}


def _load() -> Any:
    if not compiler.enabled():
        return None
    source = Path(__file__).with_name("kernels.c").read_bytes()
    path = compiler.compiled_file("kernels", source, _FLAGS)
    if not compiler.intact(path) and not compiler.compile_library(path, source, _FLAGS):
        return None
    try:
        # PyDLL keeps the interpreter lock: a kernel is shorter than releasing and taking it.
        library = ctypes.PyDLL(str(path))
    except OSError:
        return None
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


_KERNELS = _load()
AVAILABLE = _KERNELS is not None
