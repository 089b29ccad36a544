"""The derivatives of a system as sparse factors with O(N) entries: A_c = X + P V_x, B_c = U + P V_u.

X and U hold the payload's acceleration; V_x and V_u, six rows, are its own derivatives; P is its effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from model.arrays import Array, frozen
from model.state import INPUTS, OMEGA, PAYLOAD, PER_UAV

# In the order of their entries.
NAMES = ("X", "U", "P", "V_x", "V_u", "C")


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Places of the entries of all factors, one list of rows after the other."""

    shapes: tuple[tuple[int, int], ...]  # of the factors, in the order of `NAMES`
    begin: npt.NDArray[np.intp]  # first entry of each row, and the end of the last, (rows of all + 1,)
    index: npt.NDArray[np.intp]  # column of each entry

    @staticmethod
    def of(shapes: Sequence[tuple[int, int]], begins: Sequence[Sequence[int]], columns: Sequence[int]) -> "Pattern":
        """Return the pattern of factors with row beginnings of their own and columns one after the other."""
        offsets = np.cumsum([0, *(begin[-1] for begin in begins)])
        parts = [np.asarray(begin[:-1]) + offset for begin, offset in zip(begins, offsets, strict=False)]
        begin = np.concatenate([*parts, offsets[-1:]]).astype(np.intp)
        index = np.array(columns, dtype=np.intp)
        frozen(begin, index)
        return Pattern(shapes=tuple(shapes), begin=begin, index=index)

    @cached_property
    def _rows(self) -> npt.NDArray[np.intp]:
        """Row of each entry, counted through all factors."""
        return np.repeat(np.arange(len(self.begin) - 1), np.diff(self.begin))

    @cached_property
    def first_rows(self) -> list[int]:
        """First row of each factor, counted through all."""
        return np.cumsum([0, *(rows for rows, _ in self.shapes)]).tolist()  # type: ignore[no-any-return]

    @cached_property
    def addresses(self) -> tuple[int, int]:
        """Addresses of `begin` and `index`, for the compiled kernels."""
        return int(self.begin.ctypes.data), int(self.index.ctypes.data)

    def dense(self, values: Array, name: str) -> Array:
        """Return a factor as a matrix."""
        which, entries = NAMES.index(name), self._entries(name)
        found = np.zeros(self.shapes[which])
        found[self._rows[entries] - self.first_rows[which], self.index[entries]] = values[entries]
        return found

    def columns(self, name: str, columns: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Return the entries in some columns of a factor."""
        entries = self._entries(name)
        return np.arange(entries.start, entries.stop)[np.isin(self.index[entries], columns)]

    def _entries(self, name: str) -> slice:
        which = NAMES.index(name)
        return slice(*(int(self.begin[self.first_rows[which + i]]) for i in (0, 1)))


def of_matrices(A_c: Array, B_c: Array, C: Array) -> tuple[Pattern, Array]:
    """Return pattern and entries of a system whose factors are not known: X = A_c, U = B_c, no P and V."""
    n, m = B_c.shape
    matrices = [A_c, B_c, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, m)), C]
    begins = [[row * matrix.shape[1] for row in range(len(matrix) + 1)] for matrix in matrices]
    columns = np.concatenate([np.tile(np.arange(matrix.shape[1]), len(matrix)) for matrix in matrices])
    pattern = Pattern.of([matrix.shape for matrix in matrices], begins, columns.tolist())
    return pattern, np.concatenate([matrix.reshape(-1) for matrix in matrices])


def rate_places(m: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the positions of body rates as inputs, in u of m inputs, and of the rates themselves, in x."""
    uavs, axes = np.divmod(np.arange(3 * m // INPUTS), 3)
    return INPUTS * uavs + 1 + axes, PAYLOAD + PER_UAV * uavs + OMEGA.start + axes


@lru_cache(64)
def with_lag(pattern: Pattern, rates: bool = False) -> tuple[Pattern, npt.NDArray[np.intp]]:
    """Return the pattern of a system [x, a] with motors, and the order of its entries, -1/lag and 1/lag, (m,) each.

        X = [[X, U], [0, -1/lag]],    U = [[0], [1/lag]],    P = [[P], [0]],    V_x = [V_x, V_u],    V_u = 0

    With commanded body rates the row of a' also is that of the body rate, with -1/lag on itself.
    """
    (n, m), r, (p, _) = pattern.shapes[1], pattern.shapes[2][1], pattern.shapes[5]
    entries = len(pattern.index)

    def row(name: str, i: int, shift: int = 0) -> list[tuple[int, int]]:
        """Return columns, shifted, and entries of a row of a factor."""
        at = pattern.first_rows[NAMES.index(name)] + i
        return [(int(pattern.index[k]) + shift, k) for k in range(pattern.begin[at], pattern.begin[at + 1])]

    follow = [[(n + j, entries + j)] for j in range(m)]
    for j, i in zip(*rate_places(m), strict=True) if rates else ():
        follow[j] = row("X", int(i)) + follow[j]
    command = [[(j, entries + m + j)] for j in range(m)]
    factors: list[list[list[tuple[int, int]]]] = [
        [row("X", i) + row("U", i, n) for i in range(n)] + follow,
        [[] for _ in range(n)] + command,
        [row("P", i) for i in range(n)] + [[] for _ in range(m)],
        [row("V_x", i) + row("V_u", i, n) for i in range(r)],
        [[] for _ in range(r)],
        [row("C", i) for i in range(p)],
    ]
    shapes = [(n + m, n + m), (n + m, m), (n + m, r), (r, n + m), (r, m), (p, n + m)]
    begins = [np.cumsum([0, *map(len, factor)]).tolist() for factor in factors]
    flat = [entry for factor in factors for one in factor for entry in one]
    lagged = Pattern.of(shapes, begins, [column for column, _ in flat])
    return lagged, np.array([k for _, k in flat], dtype=np.intp)
