"""The compiled loops of `kernels.c`; without a C compiler `AVAILABLE` is false, and Python functions are used."""

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from model import compiler
from model.arrays import Array
from model.factors import Pattern

Places = npt.NDArray[np.intp]

_FLAGS = ("-O3", "-march=native", "-fno-math-errno")

_address, _number, _double = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double
_SIGNATURES: dict[str, tuple[Any, Sequence[Any]]] = {
    "zero_order_hold_work": (_number, [_number] * 3),
    "zero_order_hold": (_double, [_number] * 3 + [_address] * 4 + [_double] * 4 + [ctypes.c_int] + [_address] * 4),
    "predict_work": (_number, [_number] * 3),
    "respond": (None, [_address]),
    "free_response": (None, [_number] * 2 + [_address] * 3),
    "rollout": (None, [_number] * 3 + [_address] * 11),
    "condense_work": (_number, [_number] * 5),
    "fill": (None, [_address]),
    "conclude": (None, [_address] * 2 + [_double] + [_address] * 2),
    "within_bounds_work": (_number, [_number] * 2),
    "solve_within_bounds": (ctypes.c_int, [_number] * 2 + [_address] * 7 + [ctypes.c_int] + [_address] * 4),
    "residuals": (None, [_number] * 2 + [_address] * 12),
}


def zero_order_hold(
    pattern: Pattern, values: Array, f: Array, period_s: float, bounds: tuple[float, float, float], known: bool
) -> tuple[float, Array, Array, Array]:
    """Return the growth theta, A, B and f_d, meaningless if theta is too large; with `known` f_d alone."""
    (n, m), accelerations = pattern.shapes[1], pattern.shapes[2][1]
    A, B, f_d = np.empty((n, n)), np.empty((n, m)), np.empty(n)
    theta = _KERNELS.zero_order_hold(
        n, m, accelerations, *pattern.addresses, at(values), at(f),
        period_s, *bounds, known,
        at(A), at(B), at(f_d), _work("hold", _KERNELS.zero_order_hold_work(n, m, accelerations)),
    )  # fmt: skip
    return theta, A, B, f_d


class Problem(ctypes.Structure):
    """The struct `problem` of the kernels; arrays by their addresses (`at`), which do not keep them alive."""

    _fields_ = (
        *((name, _number) for name in ("steps", "n", "m", "size", "outputs", "terms", "inputs")),
        *((name, _number) for name in ("model_outputs", "all_inputs", "rank", "pairs", "angles", "known")),
        *((name, _double) for name in ("terminal", "separation", "tilt")),
        *((name, _address) for name in ("begin", "index", "value", "chosen", "answering", "own", "pair", "angle")),
        *((name, _address) for name in ("A", "B", "f_d", "K", "x0", "u0", "uncorrected", "announced", "y", "y_ref")),
        *((name, _address) for name in ("slope", "at_x0", "u_target", "Q", "scale", "effort", "low", "high", "rate")),
        *((name, _address) for name in ("root", "error", "end_slope", "penalties", "effect", "feedback", "dX", "dU")),
        *((name, _address) for name in ("U", "U_free", "H", "g", "lower", "upper", "rows", "row_lower", "row_upper")),
        *((name, _address) for name in ("S", "free", "signals", "kept", "work")),
    )


def problem(most_outputs: int, **fields: float) -> Problem:
    """Return a problem with some fields, and work space for at most that many weighted outputs."""
    new = Problem(**fields)
    predicting = _KERNELS.predict_work(new.n, new.all_inputs, new.m)
    new.work = _work("step", max(predicting, _KERNELS.condense_work(new.steps, new.n, new.m, most_outputs, new.n)))
    return new


def run(kernel: str, of: Problem) -> None:
    """Fill in the prediction (kernel respond) or the QP (kernel fill) of a problem; see `mpc.program`."""
    getattr(_KERNELS, kernel)(ctypes.addressof(of))


def conclude(of: Problem, z: Array, w: float) -> tuple[Array, Array]:
    """Return U and c of a problem's plan; see `mpc.program`."""
    U, c = np.empty((of.steps, of.m)), np.empty((of.steps, of.m))
    _KERNELS.conclude(ctypes.addressof(of), at(z), w, at(U), at(c))
    return U, c


def free_response(A: Array, W: Array) -> Array:
    """Return the response from zero to a drive, (N_p + 1, n); see `mpc.prediction`."""
    dX = np.empty((len(W) + 1, len(A)))
    _KERNELS.free_response(len(W), len(A), at(A), at(W), at(dX))
    return dX


class Step:
    """The compiled step of a model as the kernels call it: an address, and room for arguments."""

    def __init__(self, library: Any) -> None:
        sizes = (ctypes.c_longlong * 4)()
        library.step_work(*(ctypes.byref(sizes, 8 * i) for i in range(4)))
        self._duration_s = np.zeros(1)
        self._rooms = [np.zeros(size + 8, dtype=np.intp) for size in sizes]
        self._rooms[0][4] = at(self._duration_s)
        self._addresses = [ctypes.cast(library.step, _address).value, *map(at, self._rooms)]

    def rollout(
        self, x0: Array, at_x0: Array, K: Array, bounds: tuple[Array, Array], held: tuple[Array, Array],
        duration_s: float,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return states and inputs over steps of a duration, with parameters and forces held; see `mpc.tracking`."""
        Z, U = np.empty((len(at_x0) + 1, len(x0))), np.empty(at_x0.shape)
        Z[0], self._duration_s[0], self._rooms[0][2:4] = x0, duration_s, [at(array) for array in held]
        of = at(K), at(at_x0), at(bounds[0]), at(bounds[1])
        _KERNELS.rollout(len(U), len(x0), len(K), *self._addresses, *of, at(Z), at(U))
        return Z, U


def solve_within_bounds(
    shape: tuple[int, ...], program: Sequence[int], most: int
) -> tuple[int, Array, Array, tuple[float, float, float]]:
    """Return number of guesses, <= 0 without a solution, solution, multipliers and residuals; see `mpc.qp`."""
    rows, n = shape
    z, multipliers, found = np.empty(n), np.empty(n), _Residuals()
    work = _work("within_bounds", _KERNELS.within_bounds_work(n, rows))
    solution = at(z), at(multipliers), ctypes.addressof(found)
    guesses = _KERNELS.solve_within_bounds(n, rows, *program, most, *solution, work)
    return guesses, z, multipliers, tuple(found)


def residuals(
    shape: tuple[int, ...], program: Sequence[int], z: Array, bound_multipliers: Array, row_multipliers: Array
) -> tuple[float, float, float]:
    """Return stationarity, primal and complementarity, see `mpc.qp.residuals`; program as above."""
    (rows, n), found = shape, _Residuals()
    solution = at(z), at(bound_multipliers), at(row_multipliers)
    _KERNELS.residuals(n, rows, *program, *solution, ctypes.addressof(found), _work("residuals", n))
    return tuple(found)


_Residuals = ctypes.c_double * 3


def at(array: npt.NDArray[Any]) -> int:
    """Return the address of a row-major array of float64 or indices, 0 for an empty one."""
    if array.size == 0:
        return 0
    kind = _KINDS.get(array.dtype.char)
    if kind is None:
        raise TypeError(f"expected a row-major array of float64 or indices, got {array.dtype}")
    try:
        # Refuses read-only arrays, and those that are not row-major.
        return ctypes.addressof(kind(array))
    except (TypeError, ValueError):
        if not array.flags.c_contiguous:
            raise TypeError(f"expected a row-major array, got {array.dtype} with strides {array.strides}") from None
        return int(array.__array_interface__["data"][0])


_KINDS: dict[str, Callable[[Any], Any]] = {"d": _double.from_buffer, np.dtype(np.intp).char: _number.from_buffer}


def _work(which: str, size: int) -> int:
    """Return the address of a work space of that size, shared by all its calls: kernels hold the interpreter lock."""
    found = _WORK.get((which, size))
    if found is None:
        # Aligned to the widest vectors.
        space = np.zeros(size + 8)
        space = space[(-space.ctypes.data // 8) % 8 :]
        found = _WORK[which, size] = space, int(space.ctypes.data)
    return found[1]


# By kernel and size; never freed, as addresses do not keep the arrays alive.
_WORK: dict[tuple[str, int], tuple[Array, int]] = {}


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
