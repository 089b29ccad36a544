"""Tables, and their sections in a document."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from docs import tables


class BenchmarkError(RuntimeError):
    """A measurement failed; one line for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table of results, below a text about content and method of measurement."""

    text: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __str__(self) -> str:
        return f"{self.text}\n\n{tables.table(self.columns, self.rows)}"


def write(document: Path, sections: Mapping[str, str]) -> None:
    """Replace sections of a Markdown document by their new content. Raises: SystemExit: as `check`."""
    check(document, list(sections))
    for name, content in sections.items():
        tables.put(document, f"bench: {name}", content)


def check(document: Path, names: Sequence[str]) -> None:
    """Check that a document has all sections. Raises: SystemExit: it lacks one."""
    for name in names:
        tables.place(document, f"bench: {name}")
