"""Helpers for the tables of the benchmarks."""

from benchmarks.page import Table


def silent(_: str) -> None:
    """No progress."""


def first_cells(table: Table) -> list[str]:
    """What the rows are about."""
    return [row[0] for row in table.rows]


def numbers(table: Table, column: str) -> list[float]:
    """A column of medians, whatever stands in brackets behind them."""
    at = list(table.columns).index(column)
    return [float(row[at].partition(" ")[0]) for row in table.rows]
