"""Places of the entries of a linearisation's sparse factors, for Python and the kernels."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array, frozen
from transport.model.kernels import native

# Factors of a linearisation, in the order of their entries: (15b).
NAMES = ("X", "U", "P", "V_x", "V_u", "C")


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Places of the entries of the sparse factors of A_c and B_c, and of C, row by row.

    A_c = X + P V_x,  B_c = U + P V_u: docs/equations.md (15b).
    """

    shapes: tuple[tuple[int, int], ...]  # of the factors, in the order of `NAMES`
    begin: npt.NDArray[np.intp]  # first entry of each row, and the end of the last, (all rows + 1,)
    index: npt.NDArray[np.intp]  # column of each entry

    @staticmethod
    def of(factors: Sequence[Array]) -> "Pattern":
        """Return the pattern of the entries of factors that are not zero."""
        counts = [np.count_nonzero(factor, axis=1) for factor in factors]
        begin = np.cumsum([0, *np.concatenate(counts)], dtype=np.intp)
        index = np.concatenate([np.nonzero(factor)[1] for factor in factors])
        shapes = tuple((len(factor), factor.shape[1]) for factor in factors)
        frozen(begin, index)
        return Pattern(shapes=shapes, begin=begin, index=index)

    @cached_property
    def first_rows(self) -> list[int]:
        """First row of each factor, counted through all."""
        ends: list[int] = np.cumsum([0, *(rows for rows, _ in self.shapes)]).tolist()
        return ends

    @cached_property
    def addresses(self) -> tuple[int, int]:
        """Addresses of `begin` and `index`, for the compiled kernels."""
        return native.address(self.begin), native.address(self.index)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields for copies, which have addresses of their own."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def dense(self, values: Array, name: str) -> Array:
        """Return a factor as a matrix, given the entries of all factors."""
        number = NAMES.index(name)
        first = self.first_rows[number]
        end = self.first_rows[number + 1]
        begin = self.begin[first : end + 1]

        factor = np.zeros(self.shapes[number])
        entries = slice(begin[0], begin[-1])
        rows = np.repeat(np.arange(len(factor)), np.diff(begin))
        factor[rows, self.index[entries]] = values[entries]
        return factor

    def numbered(self, name: str) -> Array:
        """Return a factor as a matrix of the numbers of its entries among those of all, from 1."""
        return self.dense(np.arange(1.0, len(self.index) + 1.0), name)
