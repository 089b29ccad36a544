"""Colours and line styles of the UAVs and links in the viewer and in all figures."""

from typing import Any

import numpy as np

Colour = tuple[int, int, int]

# For colour-blind readers (after Okabe and Ito 2008), with different lightness for print in grey. Beyond five UAVs the
# colours repeat with another line style.
UAV_COLOURS = ("#004488", "#C24E00", "#009E73", "#E08BBC", "#7F5F00")
_LINE_STYLES = ("-", "--", ":", "-.")

# Ages of plans and their colours (docs/viewer.md), after that of a fresh one, which is at most `_FRESH_S` old; dark if
# older than the oldest, or without any plan.
_FRESH_S, _AGES_S = 0.1, (0.2, 0.5)
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
_OLDEST_S = 1.0
DARK: Colour = (17, 17, 17)


def uav_style(i: int) -> dict[str, Any]:
    """Return line colour and style of UAV i (0-based)."""
    return {
        "color": UAV_COLOURS[i % len(UAV_COLOURS)],
        "linestyle": _LINE_STYLES[i // len(UAV_COLOURS) % len(_LINE_STYLES)],
    }


def uav_colour(i: int) -> Colour:
    """Return the colour of UAV i (0-based), 0..255."""
    code = uav_style(i)["color"].lstrip("#")
    return int(code[:2], 16), int(code[2:4], 16), int(code[4:], 16)


def age_colour(age_s: float | None, period_s: float) -> Colour:
    """Return the colour of a link by the age of the newest plan, s; None for no plan.

    A plan that is one sampling period old is fresh: on a perfect network there is no newer one.
    """
    if age_s is None or age_s > _OLDEST_S:
        return DARK
    channels = zip(*_AGE_COLOURS, strict=True)
    r, g, b = (round(float(np.interp(age_s, (min(period_s, _FRESH_S), *_AGES_S), channel))) for channel in channels)
    return r, g, b
