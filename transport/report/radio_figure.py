"""Figure of the team's radio: airtime, deliveries and delays over time."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import NO_NEWS, Airtime
from transport.report.column import head
from transport.report.style import COMPONENTS

_HEIGHT_IN = 0.7
_BIN_S = 1.0  # airtime and deliveries are means of a second
_DOTS: Any = {"linestyle": "none", "marker": "o", "markersize": 1.4, "markeredgewidth": 0.0}


def draw_radio(
    setup: Setup, log: RunLog, _: Series, panels_of: Callable[[Sequence[float]], list[Axes]]
) -> list[Axes]:
    """Draw what the radio carried over time; no panel without one, or without news."""
    news = [one for one in log.of(Airtime) if one.agents]
    if setup.scenario.radio is None or not news:
        return []
    period_s = setup.settings.sampling_period_s
    times_s = np.array([one.tick * period_s for one in news])
    bins = (times_s // _BIN_S).astype(int)
    seconds = np.unique(bins)

    ticks = np.array(
        [
            len({one.tick for one in news if one.tick * period_s // _BIN_S == second})
            for second in seconds
        ]
    )
    busy_s = np.array([one.busy_s for one in news])
    airtime = np.array([busy_s[bins == second].sum() for second in seconds]) / (ticks * period_s)
    decided = [one.arrivals[one.arrivals != NO_NEWS] for one in news]
    delivered = [
        np.mean(
            np.concatenate([one for one, of in zip(decided, bins, strict=True) if of == second])
            >= 0.0
        )
        for second in seconds
    ]
    delays_ms = [1e3 * (one.arrivals - one.sent[:, None])[one.arrivals >= 0.0] for one in news]
    delay_times_s = np.repeat(times_s, [len(delays) for delays in delays_ms])

    panels = panels_of([_HEIGHT_IN] * 3)
    centres_s = (seconds + 0.5) * _BIN_S
    for panel, values, title in (
        (panels[0], airtime, "airtime (%)"),
        (panels[1], np.array(delivered), "plans delivered by the radio (%)"),
    ):
        panel.plot(centres_s, 100.0 * values, color=COMPONENTS[0], drawstyle="steps-mid")
        panel.set_ylim(0.0, 105.0)
        head(panel, title)
    panels[2].plot(delay_times_s, np.concatenate(delays_ms), color=COMPONENTS[0], **_DOTS)
    panels[2].set_ylim(bottom=0.0)
    head(panels[2], "delay on the air (ms)")
    return panels
