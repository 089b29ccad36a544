"""Texts of a figure as they are drawn: their places, and those that collide or leave the figure."""

import itertools

from matplotlib.axis import Axis, Tick
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

# Boxes of texts have room above and below the letters: they may overlap, or leave the figure, by
# this much, points.
_ROOM_PT = 1.5


def drawn_texts(figure: Figure) -> list[tuple[Text, Bbox]]:
    """Return the texts that are visible in a figure, each with its box, pixels."""
    figure.draw_without_rendering()
    hidden = {
        id(text)
        for axis in figure.findobj(Axis)
        for tick in _beyond(axis)
        for text in (tick.label1, tick.label2)
    }
    texts = [
        text for text in figure.findobj(Text) if isinstance(text, Text) and id(text) not in hidden
    ]
    return [
        (text, text.get_window_extent())
        for text in texts
        if text.get_visible()
        and text.get_text().strip()
        and (text.axes is None or text.axes.get_visible())
    ]


def problems(figure: Figure, smallest_pt: float) -> list[str]:
    """Return what is wrong with the texts of a figure.

    Too small, outside the figure, or one over another.
    """
    room = _ROOM_PT / 72.0 * figure.dpi
    texts = drawn_texts(figure)
    page = figure.bbox.padded(room)
    found = [
        f"{text.get_text()!r}: {text.get_fontsize()} pt"
        for text, _ in texts
        if float(text.get_fontsize()) < smallest_pt
    ]
    found += [
        f"{text.get_text()!r}: outside the figure"
        for text, box in texts
        if not (page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1)
    ]
    for (one, first), (other, second) in itertools.combinations(texts, 2):
        common = Bbox.intersection(first, second)
        if common is not None and min(common.width, common.height) > room:
            found.append(f"{one.get_text()!r} over {other.get_text()!r}")
    return found


def _beyond(axis: Axis) -> list[Tick]:
    """Return the ticks of an axis that are not drawn, since they are outside its range or have no label."""
    low, high = sorted(axis.get_view_interval())
    edge = 1e-9 * (high - low)
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    return [
        tick
        for tick in ticks
        if not low - edge <= tick.get_loc() <= high + edge or not tick.label1.get_visible()
    ]
