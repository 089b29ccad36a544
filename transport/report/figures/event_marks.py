"""Marks of the events of a run: numbered lines through all panels, and the caption that explains the numbers."""

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.log.run_log import RunLog
from transport.protocol.scenario.links.link_changes import scripted_changes
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState
from transport.report.figures.style import SMALL, shade_phases
from transport.scene.history import RunHistory, merged

_FAULT = "#B2182B"
_LINK = "#E69F00"

# Height of a line of the caption, and its distance from the panels, inches.
_LINE_IN = 0.105
_APART_IN = 0.06
_CORNER = (0.02, 0.04)  # of the caption: share of the width, and inches above the lower edge
_WRAP = 72  # characters in a line of the caption
_MOST_MARKS = 12  # that are drawn; the caption counts further ones
_OF_LINKS = re.compile(r"(\d+ |all )?links\b|target\b")  # beginning of an event's text
_BESIDE_PT, _BELOW_PT = 1.5, 1.0  # of a number from its line and from the upper edge, points
_NEAR = 0.035  # of marks nearer than this share of the run only the first has a number


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """An event at a time of the run, s; of the links, or else of a process or UAV."""

    time_s: float
    text: str
    of_links: bool


def caption_height_in(marks: Sequence[Mark]) -> float:
    """Return the height of the caption of marks with its distance from the panels, inches; 0 without marks."""
    if not marks:
        return 0.0
    return _LINE_IN * len(caption_of(marks)) + _APART_IN


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks, and how many are left out."""
    texts = [
        f"{number}: {mark.text} ({mark.time_s:g} s)"
        for number, mark in enumerate(marks[:_MOST_MARKS], start=1)
    ]
    left_out = len(marks) - _MOST_MARKS
    if left_out > 0:
        texts.append(f"{left_out} more not marked")
    return textwrap.wrap("; ".join(texts), _WRAP)


def finish(
    figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]
) -> None:
    """Shade and name the phases, and draw the first marks.

    Their numbers are in the first panel, and the caption below all.
    """
    shade_phases(setup, list(panels), until_s)
    labelled_s = -np.inf
    for number, mark in enumerate(marks[:_MOST_MARKS], start=1):
        _draw_mark(panels, mark)
        if mark.time_s - labelled_s > _NEAR * until_s:
            labelled_s = mark.time_s
            _write_number(panels[0], number, mark.time_s, until_s)

    if marks:
        left, above_in = _CORNER
        bottom = above_in / figure.get_figheight()
        figure.text(left, bottom, "\n".join(caption_of(marks)), fontsize=SMALL, va="bottom")


def _draw_mark(panels: Sequence[Axes], mark: Mark) -> None:
    """Draw a mark as a line through all panels."""
    colour = _LINK if mark.of_links else _FAULT
    dashes = ":" if mark.of_links else "-"
    for panel in panels:
        panel.axvline(mark.time_s, linewidth=0.8, zorder=1.5, color=colour, linestyle=dashes)


def _write_number(panel: Axes, number: int, time_s: float, until_s: float) -> None:
    """Write the number of a mark at its right, or at its left near the end."""
    is_near_end = time_s > (1.0 - _NEAR) * until_s
    side = "right" if is_near_end else "left"
    right_pt = -_BESIDE_PT if is_near_end else _BESIDE_PT
    place: Any = {
        "xycoords": panel.get_xaxis_transform(),
        "textcoords": "offset points",
        "va": "top",
    }
    panel.annotate(
        f"{number}", (time_s, 1.0), (right_pt, -_BELOW_PT), ha=side, fontsize=SMALL, **place
    )


def marks_of(setup: Setup, log: RunLog) -> list[Mark]:
    """Return the marks of a run in the order of time; changes that come together are one mark."""
    different = dict.fromkeys(_marks(setup, log))
    return sorted(different, key=lambda mark: mark.time_s)


def _marks(setup: Setup, log: RunLog) -> Iterator[Mark]:
    """Yield the changes of the links and the events of a run until the last tick of its log."""
    period_s = setup.settings.sampling_period_s
    last = max((entry.message.tick for entry in log.messages), default=-1)

    for time_s, text in scripted_changes(setup.scenario.links):
        if first_tick(time_s, period_s) <= last:
            yield Mark(time_s=time_s, text=text, of_links=True)

    contact = setup.contacts().over(log.of(PlantState))
    if contact is not None:
        yield Mark(time_s=round(contact.at_s, 3), text=contact.text, of_links=False)

    history = RunHistory(setup)
    history.add(entry.message for entry in log.messages)
    for tick, text in merged(history.events):
        is_link = _OF_LINKS.match(text) is not None
        yield Mark(time_s=tick * period_s, text=text.partition(" at t =")[0], of_links=is_link)
