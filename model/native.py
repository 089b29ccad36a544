"""The compiled loops of `kernels.c`: a controller's step is a hundred small matrix operations, mostly call overhead.

Without a C compiler `AVAILABLE` is false and Python functions with the same result, but for rounding, take their place.
"""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from model import compiler
from model.arrays import Array

if TYPE_CHECKING:
    from model.linearisation import Linearisation

Places = npt.NDArray[np.intp]
_PLACE = np.dtype(np.intp).char

_FLAGS = ("-O3", "-march=native", "-fno-math-errno")

_address, _number, _double = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double
_SIGNATURES: dict[str, tuple[Any, Sequence[Any]]] = {
    "zero_order_hold_work": (_number, [_number] * 3),
    "zero_order_hold": (_double, [_number] * 3 + [_address] * 4 + [_double] * 4 + [_address] * 4),
    "predict_work": (_number, [_number] * 3),
    "predict": (None, [_number] * 4 + [_address] * 11),
    "relax_work": (_number, [_number] * 2),
    "relax": (None, [_number] * 3 + [_address] * 8 + [_double] + [_address] * 6),
    "condense_work": (_number, [_number] * 5),
    "condense": (None, [_address]),
    "toeplitz": (None, [_number] * 3 + [_address] * 2 + [_number]),
    "distances": (None, [_number] * 3 + [_address] + [_number] + [_address] * 5),
    "within_bounds_work": (_number, [_number]),
    "within_bounds": (ctypes.c_int, [_number] + [_address] * 4 + [ctypes.c_int] + [_address] * 3),
    "residuals": (None, [_number] * 2 + [_address] * 12),
}


def zero_order_hold(
    linear: "Linearisation", period_s: float, theta_max: float, theta_possible: float, remainder: float
) -> tuple[float, Array, Array, Array]:
    """Return the growth theta, A, B and f_d; the last three are meaningless if theta > theta_possible or nan.

    Arguments as in `model.discretisation`; the period is halved above theta_max.
    """
    (n, m), accelerations = linear.pattern.shapes[1], linear.pattern.shapes[2][1]
    A, B, f_d = np.empty((n, n)), np.empty((n, m)), np.empty(n)
    theta = _KERNELS.zero_order_hold(
        n, m, accelerations, *linear.pattern.addresses, _at(linear.values), _at(linear.f),
        period_s, theta_max, theta_possible, remainder,
        _at(A), _at(B), _at(f_d), _work("zero_order_hold_work", n, m, accelerations),
    )  # fmt: skip
    return theta, A, B, f_d


def predict(
    A: Array, B: Array, f_d: Array, own: Places, K: Array | None, drive: Array
) -> tuple[Array, Array, Array, Array]:
    """Return impulse, dX, feedback and dU; see `mpc.prediction`."""
    steps, (n, m), count = len(drive), B.shape, len(own)
    fed = 0 if K is None else m
    impulse, dX = np.empty((n, steps, count)), np.empty((steps + 1, n))
    feedback, dU = np.empty((fed, steps, count)), np.empty((steps, fed))
    _KERNELS.predict(
        steps, n, m, count, _place(own), _at(A), _at(B), _at(f_d), 0 if K is None else _at(K), _at(drive),
        _at(impulse), _at(dX), _at(feedback), _at(dU), _work("predict_work", n, m, count),
    )  # fmt: skip
    return impulse, dX, feedback, dU


def relax(
    own: Places, z: Array, scale: Array, U_free: Array, uncorrected: Array, previous: Array, dU: Array,
    feedback: Array, w: float, lower: Array, upper: Array, rate: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return U and c; see `mpc.plan`."""
    U, c = np.empty(U_free.shape), np.empty(U_free.shape)
    _KERNELS.relax(
        *U.shape, dU.shape[1], _place(own), _at(z), _at(scale), _at(U_free), _at(uncorrected), _at(previous), _at(dU),
        _at(feedback), w, _at(lower), _at(upper), _at(rate), _at(U), _at(c), _work("relax_work", *U.shape),
    )  # fmt: skip
    return U, c


class Cost(ctypes.Structure):
    """The struct `cost` of the kernels."""

    _fields_ = (
        *((name, _number) for name in ("steps", "n", "m", "size", "outputs", "terms", "inputs")),
        *((name, _number) for name in ("model_outputs", "all_inputs", "rank")),
        ("terminal", _double),
        *((name, _address) for name in ("begin", "index", "value", "chosen", "answering", "own")),
        *((name, _address) for name in ("y", "y_ref", "slope", "at_x0", "effect", "feedback", "dX", "U", "u_target")),
        *((name, _address) for name in ("Q", "scale", "effort", "root", "error", "end_slope", "penalties")),
        *((name, _address) for name in ("H", "g", "S", "free", "work")),
    )


def condense(
    linear: "Linearisation", chosen: Places, answering: Places, own: Places, terminal: float, y_ref: Array,
    slope: Array, at_x0: Array, effect: Array, feedback: Array, dX: Array, U: Array, u_target: Array, Q: Array,
    scale: Array, effort: Array, root: Array, error: Array, end_slope: Array, penalties: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return H, g, S and the free response of the chosen outputs; see `mpc.objective`."""
    (n, steps, m), p, rank = effect.shape, len(Q), len(root)
    size, outputs, pattern = steps * m + len(penalties), len(chosen), linear.pattern
    H, g, S, free = np.empty((size, size)), np.empty(size), np.empty((p, steps, m)), np.empty((steps, outputs))
    begin, index = pattern.addresses
    cost = Cost(
        steps, n, m, size, outputs, len(at_x0), len(answering), len(linear.y), len(u_target), rank, terminal,
        begin + 8 * pattern.first_rows[-2], index, _at(linear.values), _place(chosen), _place(answering), _place(own),
        _at(linear.y), _at(y_ref), _at(slope), _at(at_x0), _at(effect), _at(feedback), _at(dX), _at(U), _at(u_target),
        _at(Q), _at(scale), _at(effort), _at(root), _at(error), _at(end_slope), _at(penalties),
        _at(H), _at(g), _at(S), _at(free), _work("condense_work", steps, n, m, p, rank),
    )  # fmt: skip
    _KERNELS.condense(ctypes.addressof(cost))
    return H, g, S, free


def toeplitz(impulse: Array, rows: Array) -> None:
    """See `mpc.condensing.fill`."""
    s, steps, m = impulse.shape
    _KERNELS.toeplitz(steps, s, m, _at(impulse), _at(rows), rows.shape[1])


def distances(pairs: Places, r: Array, free: Array, effect: Array) -> tuple[Array, Array]:
    """Return the effect of decisions on distances, and the distances; see `mpc.rows.separation`."""
    (_, steps, m), count = effect.shape, len(pairs)
    by, distance = np.empty((count, steps, m)), np.empty((steps, count))
    _KERNELS.distances(
        steps, m, count, _place(pairs), free.shape[1], _at(r), _at(free), _at(effect), _at(by), _at(distance)
    )  # fmt: skip
    return by, distance


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
    if array.dtype.char != "d":
        raise TypeError(f"expected a row-major array of float64, got {array.dtype}")
    try:
        # Refuses read-only arrays, and those that are not row-major.
        return ctypes.addressof(_DOUBLE_IN(array))  # type: ignore[arg-type]  # an array is a buffer
    except (TypeError, ValueError):
        return _read_only(array)


def _place(indices: Places) -> int:
    """Return the address of row-major indices, 0 for no indices."""
    if indices.size == 0:
        return 0
    if indices.dtype.char != _PLACE:
        raise TypeError(f"expected row-major indices, got {indices.dtype}")
    try:
        return ctypes.addressof(_PLACE_IN(indices))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return _read_only(indices)


def _read_only(array: npt.NDArray[Any]) -> int:
    """Return the address of a read-only array; those met again, such as gains, are looked up."""
    found = _READ_ONLY.get(id(array))
    if found is None:
        if not array.flags.c_contiguous:
            raise TypeError(f"expected a row-major array, got {array.dtype} with strides {array.strides}")
        if len(_READ_ONLY) >= _MOST_READ_ONLY:
            _READ_ONLY.clear()
        found = _READ_ONLY[id(array)] = array, int(array.ctypes.data)
    return found[1]


_DOUBLE_IN, _PLACE_IN = ctypes.c_double.from_buffer, ctypes.c_ssize_t.from_buffer
# By identity; the arrays are kept, so that no other has the same one.
_READ_ONLY: dict[int, tuple[npt.NDArray[Any], int]] = {}
_MOST_READ_ONLY = 256


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
