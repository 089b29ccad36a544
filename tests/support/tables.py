"""Helpers for tests of the tables of the benchmarks."""

from benchmarks.page import Table


def silent(_: str) -> None:
    """Ignore progress messages."""


def first_cells(table: Table) -> list[str]:
    """Return the first cell of every row."""
    return [row[0] for row in table.rows]


def numbers(table: Table, column: str) -> list[float]:
    """Return a column of medians, without the spread in brackets."""
    at = list(table.columns).index(column)
    return [float(row[at].partition(" ")[0]) for row in table.rows]
