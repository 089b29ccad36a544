"""Sections of a page: a text about content and method of measurement, a table, and where its numbers come from."""

import platform
import time
from collections.abc import Sequence

from docs.tables import table
from transport.flight.header import machine


class BenchmarkError(RuntimeError):
    """A measurement failed; one line for the user."""


def section(text: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown below its text."""
    return f"{text}\n\n{table(columns, rows)}"


def origin() -> str:
    """Return the machine and the date."""
    return f"{machine()}, Python {platform.python_version()}; {time.strftime('%Y-%m-%d')}"
