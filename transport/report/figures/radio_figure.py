"""Figure of the team's radio: airtime, deliveries and delays over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Airtime
from transport.report.figures.column import head
from transport.report.figures.curves_over_time import Panels
from transport.report.figures.style import COMPONENTS

_HEIGHT_IN = 0.7
_BIN_S = 1.0  # airtime and deliveries are means of a second
_MS_PER_S = 1e3
_PERCENT = 100.0
_HIGHEST_PERCENT = 105.0  # of the axes
_DOTS: Any = {"linestyle": "none", "marker": "o", "markersize": 1.4, "markeredgewidth": 0.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Means:
    """Means of S seconds of a run that have airtime messages."""

    centres_s: Array  # (S,)
    airtime: Array  # share of the time in which the channel was busy, (S,)
    delivered: Array  # share of the plans, (S,)


def draw_radio(setup: Setup, log: RunLog, _: Series, panels_of: Panels) -> list[Axes]:
    """Draw airtime, deliveries and delays of the radio; no panel without one, or without airtime messages."""
    airtimes = [one for one in log.of(Airtime) if one.agents]
    if setup.scenario.radio is None or not airtimes:
        return []

    period_s = setup.settings.sampling_period_s
    means = _means(airtimes, period_s)
    panels = panels_of([_HEIGHT_IN] * 3)
    airtime, delivered, delay = panels
    _draw_share(airtime, means.centres_s, means.airtime, "airtime (%)")
    _draw_share(delivered, means.centres_s, means.delivered, "plans delivered by the radio (%)")
    _draw_delays(delay, airtimes, period_s)
    return panels


def _means(airtimes: Sequence[Airtime], period_s: float) -> _Means:
    """Return the means of each second with airtime messages."""
    by_second: dict[int, list[Airtime]] = {}
    for one in airtimes:
        second = int(one.tick * period_s // _BIN_S)
        by_second.setdefault(second, []).append(one)

    seconds = sorted(by_second)
    of_seconds = [by_second[second] for second in seconds]
    return _Means(
        centres_s=(np.array(seconds) + 0.5) * _BIN_S,
        airtime=np.array([_airtime(own, period_s) for own in of_seconds]),
        delivered=np.array([_delivered(own) for own in of_seconds]),
    )


def _airtime(airtimes: Sequence[Airtime], period_s: float) -> float:
    """Return the share of the time in which the channel was busy."""
    ticks = len({one.tick for one in airtimes})
    busy_s = np.array([one.busy_s for one in airtimes]).sum()
    return float(busy_s / (ticks * period_s))


def _delivered(airtimes: Sequence[Airtime]) -> float:
    """Return the share of plans that arrived, of those that arrived or were lost."""
    sent = np.concatenate([one.of_sent() for one in airtimes])
    return float(np.mean(sent >= 0.0)) if len(sent) else math.nan


def _draw_share(panel: Axes, centres_s: Array, shares: Array, title: str) -> None:
    """Draw a share of each second, %."""
    panel.plot(centres_s, _PERCENT * shares, color=COMPONENTS[0], drawstyle="steps-mid")
    panel.set_ylim(0.0, _HIGHEST_PERCENT)
    head(panel, title)


def _draw_delays(panel: Axes, airtimes: Sequence[Airtime], period_s: float) -> None:
    """Draw the time of each plan from its send to its arrival, ms."""
    times_s: list[float] = []
    delays_ms: list[float] = []
    for one in airtimes:
        delay_ms = _MS_PER_S * (one.arrivals - one.sent[:, None])[one.arrivals >= 0.0]
        delays_ms += delay_ms.tolist()
        times_s += [one.tick * period_s] * len(delay_ms)

    panel.plot(times_s, delays_ms, color=COMPONENTS[0], **_DOTS)
    panel.set_ylim(bottom=0.0)
    head(panel, "delay on the air (ms)")
