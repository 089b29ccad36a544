"""The compiled loops of `kernels.c`.

Without a C compiler `AVAILABLE` is false, and Python functions are used.
"""

import ctypes
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array
from transport.model.kernels import compiler

Places = npt.NDArray[np.intp]

_ALIGNMENT = 64  # of work spaces, bytes: the widest vectors of a processor

_address = ctypes.c_void_p
_number = ctypes.c_ssize_t
_double = ctypes.c_double

# Results and arguments of the kernels.
_SIGNATURES: dict[str, tuple[Any, Sequence[Any]]] = {
    "vector_width": (ctypes.c_int, []),
    "zero_order_hold_work": (_number, [_number] * 3),
    "zero_order_hold": (
        _double,
        [_number] * 3 + [_address] * 4 + [_double] * 4 + [ctypes.c_int] + [_address] * 5,
    ),
    "predict_work": (_number, [_number] * 3),
    "respond": (None, [_address]),
    "free_response": (None, [_number] * 2 + [_address] * 3),
    "rollout": (None, [_number] * 3 + [_address] * 5 + [ctypes.c_int] + [_address] * 6),
    "condense_work": (_number, [_number] * 5),
    "kept_work": (_number, [_number] * 5),
    "fill": (None, [_address]),
    "conclude": (None, [_address] * 2 + [_double] + [_address] * 2),
    "alone_inputs": (None, [_address] * 6),
    "within_bounds_work": (_number, [_number] * 2),
    "solve_within_bounds": (
        ctypes.c_int,
        [_number] * 2 + [_address] * 7 + [ctypes.c_int] + [_address] * 4,
    ),
    "residuals": (None, [_number] * 2 + [_address] * 12),
}

_SOURCE = Path(__file__).with_name("kernels.c")
_TYPES = {"ptrdiff_t": _number, "double": _double}


def _fields_of(struct: str) -> Iterator[tuple[str, Any]]:
    """Yield name and type of each field of a struct, as the source declares them."""
    source = re.sub(r"/\*.*?\*/", "", _SOURCE.read_text(encoding="utf-8"), flags=re.DOTALL)
    (declared,) = re.findall(rf"typedef struct {{([^}}]*)}} {struct};", source)
    for declaration in declared.replace("const ", "").split(";")[:-1]:
        of, names = declaration.split(maxsplit=1)
        for name in map(str.strip, names.split(",")):
            yield name.lstrip("*"), _address if name.startswith("*") else _TYPES[of]


class Problem(ctypes.Structure):
    """The struct `problem` of the kernels.

    Arrays by their addresses (`address`), which do not keep them alive.
    """

    _fields_ = tuple(_fields_of("problem"))


_KINDS: dict[str, Callable[[Any], Any]] = {
    "d": _double.from_buffer,
    np.dtype(np.intp).char: _number.from_buffer,
}


def address(array: npt.NDArray[Any]) -> int:
    """Return the address of a row-major array of float64 or indices, 0 for an empty one.

    Raises: TypeError: an array of another type or layout.
    """
    if array.size == 0:
        return 0
    try:
        return ctypes.addressof(_KINDS[array.dtype.char](array))
    except (KeyError, TypeError, ValueError):  # another type, read-only, or not row-major
        if array.flags.c_contiguous and array.dtype.char in _KINDS:
            return int(array.__array_interface__["data"][0])
        expected = "expected a row-major array of float64 or indices"
        got = f"got {array.dtype} with strides {array.strides}"
        raise TypeError(f"{expected}, {got}") from None


class Addresses:
    """Addresses of arrays by name, kept as long as a name stands for the same array."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[npt.NDArray[Any], int]] = {}

    def array(self, name: str) -> npt.NDArray[Any] | None:
        """Return the array that a name stands for."""
        kept = self._kept.get(name)
        return None if kept is None else kept[0]

    def address_of(self, name: str, array: npt.NDArray[Any]) -> int | None:
        """Return the address of an array if a name stands for it."""
        kept = self._kept.get(name)
        return None if kept is None or kept[0] is not array else kept[1]

    def of(self, name: str, array: npt.NDArray[Any]) -> int:
        """Return the address of an array, which a name stands for from now on.

        The array is the caller's: a name is used here or with `copied`, which writes into it.
        """
        kept = self._kept.get(name)
        if kept is not None and kept[0] is array:
            return kept[1]
        self._kept[name] = array, address(array)
        return self._kept[name][1]

    def copied(self, name: str, array: Array) -> int:
        """Copy an array into the one kept under a name, and return the address of that.

        A copy takes less time than the address of a new array, above all of a read-only one.
        """
        kept = self._kept.get(name)
        if kept is None or kept[0].shape != array.shape:
            return self.of(name, np.array(array, dtype=np.float64, order="C"))
        kept[0][...] = array
        return kept[1]


class _WorkSpace:
    """Memory for a kernel, aligned."""

    def __init__(self, size: int) -> None:
        self._memory: Array = np.zeros(size + _ALIGNMENT // 8)
        unaligned = address(self._memory)
        self.address = unaligned + -unaligned % _ALIGNMENT


# By kernel and size; never freed, as addresses do not keep the memory alive.
_WORK_SPACES: dict[tuple[str, int], _WorkSpace] = {}


def work(kernel: str, size: int) -> int:
    """Return the address of a work space of that size, shared by all calls of a kernel.

    Kernels hold the interpreter lock.
    """
    space = _WORK_SPACES.get((kernel, size))
    if space is None:
        space = _WorkSpace(size)
        _WORK_SPACES[kernel, size] = space
    return space.address


def load() -> Any:
    """Return the compiled kernels; None where they are switched off or cannot be compiled."""
    if not compiler.enabled():
        return None

    source = _SOURCE.read_bytes()
    flags = (*compiler.LOOP_FLAGS, *compiler.processor_flags())
    path = compiler.compiled_file("kernels", source, flags)
    if not compiler.compile_library(path, [source], flags):
        return None
    try:
        # PyDLL keeps the interpreter lock: a kernel is shorter than releasing and taking it.
        library = ctypes.PyDLL(str(path))
    except OSError:
        return None

    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments
    return library


KERNELS = load()
AVAILABLE = KERNELS is not None


def description() -> str:
    """Return whether the kernels are compiled, and how many doubles their vectors have."""
    return f"compiled, vectors of {KERNELS.vector_width()}" if AVAILABLE else "plain"
