"""The compiled loops of `kernels.c`.

Without a C compiler `AVAILABLE` is false, and Python functions are used.
"""

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from transport.model import compiler
from transport.model.arrays import Array

Places = npt.NDArray[np.intp]

_FLAGS = ("-O3", "-march=native", "-fno-math-errno")

_address, _number, _double = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double
_SIGNATURES: dict[str, tuple[Any, Sequence[Any]]] = {
    "zero_order_hold_work": (_number, [_number] * 3),
    "zero_order_hold": (
        _double,
        [_number] * 3 + [_address] * 4 + [_double] * 4 + [ctypes.c_int] + [_address] * 4,
    ),
    "predict_work": (_number, [_number] * 3),
    "respond": (None, [_address]),
    "free_response": (None, [_number] * 2 + [_address] * 3),
    "rollout": (None, [_number] * 3 + [_address] * 11),
    "condense_work": (_number, [_number] * 5),
    "fill": (None, [_address]),
    "conclude": (None, [_address] * 2 + [_double] + [_address] * 2),
    "within_bounds_work": (_number, [_number] * 2),
    "solve_within_bounds": (
        ctypes.c_int,
        [_number] * 2 + [_address] * 7 + [ctypes.c_int] + [_address] * 4,
    ),
    "residuals": (None, [_number] * 2 + [_address] * 12),
}


class Problem(ctypes.Structure):
    """The struct `problem` of the kernels.

    Arrays by their addresses (`at`), which do not keep them alive.
    """

    _fields_ = (
        *((name, _number) for name in ("steps", "n", "m", "size", "outputs", "terms", "inputs")),
        *(
            (name, _number)
            for name in ("model_outputs", "all_inputs", "rank", "pairs", "angles", "known")
        ),
        *((name, _double) for name in ("terminal", "separation", "tilt")),
        *(
            (name, _address)
            for name in ("begin", "index", "value", "chosen", "answering", "own", "pair", "angle")
        ),
        *(
            (name, _address)
            for name in ("A", "B", "f_d", "K", "x0", "u0", "uncorrected", "announced", "y", "y_ref")
        ),
        *(
            (name, _address)
            for name in (
                "slope",
                "at_x0",
                "u_target",
                "Q",
                "scale",
                "effort",
                "low",
                "high",
                "rate",
            )
        ),
        *(
            (name, _address)
            for name in (
                "root",
                "error",
                "end_slope",
                "penalties",
                "effect",
                "feedback",
                "dX",
                "dU",
            )
        ),
        *(
            (name, _address)
            for name in (
                "U",
                "U_free",
                "H",
                "g",
                "lower",
                "upper",
                "rows",
                "row_lower",
                "row_upper",
            )
        ),
        *((name, _address) for name in ("S", "free", "signals", "kept", "work")),
    )


def at(array: npt.NDArray[Any]) -> int:
    """Return the address of a row-major array of float64 or indices, 0 for an empty one."""
    if array.size == 0:
        return 0
    try:
        return ctypes.addressof(_KINDS[array.dtype.char](array))
    except (KeyError, TypeError, ValueError):  # another type, read-only, or not row-major
        if not array.flags.c_contiguous or array.dtype.char not in _KINDS:
            raise TypeError(
                f"expected a row-major array of float64 or indices, got {array.dtype} with strides {array.strides}"
            ) from None
        return int(array.__array_interface__["data"][0])


_KINDS: dict[str, Callable[[Any], Any]] = {
    "d": _double.from_buffer,
    np.dtype(np.intp).char: _number.from_buffer,
}


def work(which: str, size: int) -> int:
    """Return the address of a work space of that size, shared by all its calls.

    Kernels hold the interpreter lock.
    """
    found = _WORK.get((which, size))
    if found is None:
        space = np.zeros(size + 8)
        found = _WORK[which, size] = (
            space,
            at(space) + -at(space) % 64,
        )  # aligned to the widest vectors
    return found[1]


# By kernel and size; never freed, as addresses do not keep the arrays alive.
_WORK: dict[tuple[str, int], tuple[Array, int]] = {}


def _load() -> Any:
    if not compiler.enabled():
        return None
    source = Path(__file__).with_name("kernels.c").read_bytes()
    path = compiler.compiled_file("kernels", source, _FLAGS)
    if not compiler.compile_library(path, source, _FLAGS):
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


KERNELS = _load()
AVAILABLE = KERNELS is not None
