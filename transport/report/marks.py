"""Marks of a run in its figures: faults, returns and changes of links, as numbered vertical lines with a caption."""

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from protocol.scenario.link_words import change_in_words, words_of
from protocol.scenario.setup import Setup
from protocol.wire.messages import FaultNote, LinkChange, Roster
from transport.log.run_log import RunLog

_FAULT, _LINK = "#B2182B", "#E69F00"
_FONT, _LINE_IN, _APART_IN = 6.0, 0.105, 0.06
# Characters in a line of the caption; most marks in it; marks nearer than this share of the axis have one label.
_WRAP, _MOST, _NEAR = 72, 12, 0.035


@dataclass(frozen=True, slots=True)
class Mark:
    """An event at a time of the run, s; of the links, or else of a process or UAV."""

    time_s: float
    text: str
    of_links: bool


def marks_of(setup: Setup, log: RunLog) -> list[Mark]:
    """Return the marks of a run in the order of time; changes that come together are one mark."""
    found = sorted(dict.fromkeys(_marks(setup, log)), key=lambda mark: mark.time_s)
    return found[:_MOST]


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks."""
    texts = [f"{number}: {mark.text} ({mark.time_s:g} s)" for number, mark in enumerate(marks, start=1)]
    return textwrap.wrap("; ".join(texts), _WRAP) if texts else []


def caption_height_in(marks: Sequence[Mark]) -> float:
    """Return the height of the caption with its distance from the figure, inches."""
    return _LINE_IN * len(caption_of(marks)) + (_APART_IN if marks else 0.0)


def draw_marks(figure: Figure, panels: Sequence[Axes], marks: Sequence[Mark]) -> None:
    """Draw the lines into stacked panels over time, their numbers into the first, and the caption below the figure."""
    until_s = panels[0].get_xlim()[1]
    last: list[tuple[float, str]] = []
    for number, mark in enumerate(marks, start=1):
        colour = _LINK if mark.of_links else _FAULT
        style: Any = {"color": colour, "linewidth": 0.8, "linestyle": ":" if mark.of_links else "-", "zorder": 1.5}
        for panel in panels:
            panel.axvline(mark.time_s, **style)
        if last and mark.time_s - last[-1][0] < _NEAR * until_s:
            last[-1] = (last[-1][0], f"{last[-1][1].split('-')[0]}-{number}")
        else:
            last.append((mark.time_s, str(number)))
    for time_s, label in last:
        at_edge = time_s > (1.0 - _NEAR) * until_s
        panels[0].annotate(
            label,
            (time_s, 1.0),
            (-1.5 if at_edge else 1.5, -1.0),
            xycoords=panels[0].get_xaxis_transform(),
            textcoords="offset points",
            ha="right" if at_edge else "left",
            va="top",
            fontsize=_FONT,
        )
    if marks:
        figure.text(0.02, 0.04 / figure.get_figheight(), "\n".join(caption_of(marks)), fontsize=_FONT, va="bottom")


def _marks(setup: Setup, log: RunLog) -> Iterator[Mark]:
    period_s, links = setup.settings.sampling_period_s, setup.scenario.links
    end_s = (setup.ticks if log.messages else 0) * period_s
    for change in links.change:
        yield Mark(change.at_s, change_in_words(change.from_ or "", change.to or "", change.settings()), True)
    for partition in links.partition:
        names = ", ".join(partition.between)
        yield Mark(partition.start_s, f"{names} cut off", True)
        if partition.end_s < end_s:
            yield Mark(partition.end_s, f"{names} connected again", True)
    off: tuple[int, ...] = ()
    numbers: set[int] = set()
    for message in (entry.message for entry in log.messages):
        if isinstance(message, FaultNote):
            yield Mark(message.tick * period_s, f"{message.target} {message.what}", False)
        elif isinstance(message, LinkChange) and message.number not in numbers:
            numbers.add(message.number)  # repeated for an agent that joins late
            yield Mark(message.tick * period_s, words_of(message), True)
        elif isinstance(message, Roster) and message.off != off:
            off = message.off
            yield Mark(message.tick * period_s, message.reason.partition(" at t =")[0], False)
