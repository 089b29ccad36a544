"""Colours and line styles of the UAVs, the same in the viewer and in every figure."""

from typing import Any

# Okabe and Ito (2008). A UAV has the same colour in every figure; beyond five, the line style tells the turn.
UAV_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#7F5F00")
_TURNS = ("-", "--", ":", "-.")


def uav_style(i: int) -> dict[str, Any]:
    """Line colour and style of UAV i (0-based)."""
    return {"color": UAV_COLOURS[i % len(UAV_COLOURS)], "linestyle": _TURNS[i // len(UAV_COLOURS) % len(_TURNS)]}
