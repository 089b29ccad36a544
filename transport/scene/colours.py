"""Colours and line styles of the UAVs in the viewer and in all figures."""

from typing import Any

# For colour-blind readers (after Okabe and Ito 2008), with different lightness for print in grey. Beyond five UAVs the
# colours repeat with another line style.
UAV_COLOURS = ("#004488", "#C24E00", "#009E73", "#E08BBC", "#7F5F00")
_LINE_STYLES = ("-", "--", ":", "-.")


def uav_style(i: int) -> dict[str, Any]:
    """Return line colour and style of UAV i (0-based)."""
    return {
        "color": UAV_COLOURS[i % len(UAV_COLOURS)],
        "linestyle": _LINE_STYLES[i // len(UAV_COLOURS) % len(_LINE_STYLES)],
    }
