"""Colours of a drawing: of UAVs, and of links by the age of plans."""

from typing import Any

import numpy as np

from transport.scene.lines_meshes_and_labels import Colour

# For colour-blind readers and print in grey (after Okabe and Ito 2008), repeated with other line
# styles.
UAV_COLOURS = ("#004488", "#C24E00", "#009E73", "#E08BBC", "#7F5F00")
_LINE_STYLES = ("-", "--", ":", "-.")
_MARKERS = ("o", "s", "^", "D")

# Ages of plans, s, and their colours (docs/viewer.md), that of a fresh one first.
_FRESH_S = 0.1
_AGES_S = (0.2, 0.5)
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
# Colour of links with an older plan than this, s, or without any.
_OLDEST_S = 1.0
DARK: Colour = (17, 17, 17)

# Colour of a UAV whose agent is not on the roster.
OFF_COLOUR: Colour = (170, 170, 170)


def uav_style(i: int) -> dict[str, Any]:
    """Return line colour and style of UAV i (0-based)."""
    cycle, colour = divmod(i, len(UAV_COLOURS))
    return {"color": UAV_COLOURS[colour], "linestyle": _LINE_STYLES[cycle % len(_LINE_STYLES)]}


def uav_marker(i: int) -> str:
    """Return the marker of UAV i (0-based), another one where colours repeat."""
    return _MARKERS[i // len(UAV_COLOURS) % len(_MARKERS)]


def uav_colour(i: int) -> Colour:
    """Return the colour of UAV i (0-based), 0..255."""
    r, g, b = bytes.fromhex(uav_style(i)["color"].lstrip("#"))
    return r, g, b


def age_colour(age_s: float | None, period_s: float) -> Colour:
    """Return the colour of a link by the age of the newest plan, s, fresh until one period.

    None for no plan.
    """
    if age_s is None or age_s > _OLDEST_S:
        return DARK

    ages_s = (min(period_s, _FRESH_S), *_AGES_S)
    channels = zip(*_AGE_COLOURS, strict=True)
    r, g, b = (round(float(np.interp(age_s, ages_s, channel))) for channel in channels)
    return r, g, b
