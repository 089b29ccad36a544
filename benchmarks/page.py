"""Tables, and their sections in a document."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


class BenchmarkError(RuntimeError):
    """A measurement or its document failed; one line for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table of results, below a text about content and method of measurement."""

    text: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"row {list(row)}: expected {len(self.columns)} cells, got {len(row)}")

    def __str__(self) -> str:
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join([self.text, "", *("| " + " | ".join(cells) + " |" for cells in lines)])


def write(document: Path, sections: Mapping[str, str]) -> None:
    """Replace sections of a Markdown document by their new content, all or none.

    Raises: BenchmarkError: as `check`.
    """
    text = check(document, list(sections))
    for name, content in sections.items():
        text = _section(name).sub(lambda found, new=content: f"{found[1]}\n{new}\n{found[2]}", text)  # type: ignore[misc]
    partial = document.with_name(f"{document.name}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, document)


def check(document: Path, names: Sequence[str]) -> str:
    """Return the text of a document that has all sections.

    Raises: BenchmarkError: the document cannot be read, or lacks a section.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise BenchmarkError(f"{document}: cannot be read ({error.strerror})") from error
    for name in names:
        count = len(_section(name).findall(text))
        if count != 1:
            raise BenchmarkError(
                f"{document}: expected <!-- bench: {name} --> ... <!-- end of bench --> once, got {count}"
            )
    return text


def _section(name: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- bench: {re.escape(name)} -->)\n.*?(<!-- end of bench -->)", re.DOTALL)
