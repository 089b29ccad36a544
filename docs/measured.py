"""Measured parts of documents: runs, and the text and figures that are made from their results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from transport.experiments.cases import Case
from transport.experiments.simulation import Result


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A table with its runs.

    Attributes:
        name: Name of its markers and of its kept results.
        document: The page.
        cases: Its runs.
        texts: Each run in words.
        text: Returns what stands between the markers, for results in the order of the runs.
        draw: Draws the figures of the page; nothing for a table without any.
        is_timed: Whether its runs take one core each, one at a time, for their processor times.
    """

    name: str
    document: Path
    cases: Sequence[Case]
    texts: Sequence[str]
    text: Callable[[Sequence[Result]], str]
    draw: Callable[[Sequence[Result]], None] | None = None
    is_timed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Derived:
    """A table made from the results of others.

    Attributes:
        name: Name of its markers.
        document: The page.
        sources: Names of the others.
        text: Returns what stands between the markers, for the results of the others by name.
    """

    name: str
    document: Path
    sources: Sequence[str]
    text: Callable[[Mapping[str, Sequence[Result]]], str]
