"""Tables, and their places in a document."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


class BenchmarkError(RuntimeError):
    """Something that could not be measured or written down; one line for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table of results.

    Attributes:
        text: What is in it, and how it was measured.
        columns: Headings.
        rows: Cells.
    """

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
    """Replace sections of a document, all or none.

    Args:
        document: Markdown.
        sections: What is to stand between the markers of each.
    Raises: BenchmarkError: no such markers, or no such file.
    """
    text = _read(document)
    for name, content in sections.items():
        text = _place(document, text, name).sub(lambda found, new=content: f"{found[1]}\n{new}\n{found[2]}", text)  # type: ignore[misc]
    partial = document.with_name(f"{document.name}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, document)


def check(document: Path, names: Sequence[str]) -> None:
    """Refuse a document that lacks a section, before minutes are spent on it.

    Raises: BenchmarkError: naming the first.
    """
    text = _read(document)
    for name in names:
        _place(document, text, name)


def _read(document: Path) -> str:
    try:
        return document.read_text(encoding="utf-8")
    except OSError as error:
        raise BenchmarkError(f"{document}: cannot be read ({error.strerror})") from error


def _place(document: Path, text: str, name: str) -> re.Pattern[str]:
    pattern = re.compile(rf"(<!-- bench: {re.escape(name)} -->)\n.*?(<!-- end of bench -->)", re.DOTALL)
    found = pattern.findall(text)
    if len(found) != 1:
        raise BenchmarkError(
            f"{document}: expected <!-- bench: {name} --> ... <!-- end of bench --> once, got {len(found)}"
        )
    return pattern
