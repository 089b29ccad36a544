"""Plots in the panel: over a recorded run, or the last seconds of an active one."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.scene.scene_at_tick import SceneBuilder
from transport.scene.uav_and_link_colours import uav_style

# Time axis of an active run, s.
SPAN_S = 30.0
# Most points of a curve.
_POINTS = 300
_HEIGHT_PX = 150
# Width of the values of the vertical axis and height of those of the horizontal one, pixels: for
# five characters of the font.
_AXIS_PX = {"x": 26, "y": 56}
_LABEL_PX = 16
# Above, right, below, left: half a value at the upper end, and at the right one.
_PADDING_PX = (10, 24, 0, 0)
_FONT = "10px sans-serif"
_BLACK = "#000000"
# Ranges that the vertical axes show at least, as a single value has none: payload error, m; cost, powers of ten;
# ages, sampling periods; thrust, parts of that at hover.
_ERROR_M = (0.0, 0.01)
_COST_DECADES = (-6.0, -3.0)
_AGE_PERIODS = (0.0, 2.0)
_THRUST_OF_HOVER = (0.98, 1.02)
# Smaller costs are rounding errors.
_LEAST_COST = 1e-8
# Steps of a vertical axis, at most, and the least part of it that curves need.
_STEPS = 5
_LEAST_PART = 0.3
# Rounding of an end that is a whole number of steps.
_ROUNDING = 1e-9
# Distance of values off the axis from it, in lengths of the axis.
_FAR = 100.0


@dataclass(frozen=True, slots=True)
class PlottedQuantity:
    """A quantity of a run to be plotted."""

    title: str
    unit: str  # name of the vertical axis
    colours: tuple[str, ...]  # of its curves
    range: tuple[float, ...]  # ends of the axis at least


class Plots:
    """Four plots of a run.

    Those of a recorded run have the whole recorded time and a line at the shown instant. Those of
    an active run have the time before the shown instant, as a browser moves no axis with its data.
    """

    def __init__(self, gui: Any, builder: SceneBuilder, *, whole: bool) -> None:
        self._builder = builder
        setup = builder.setup
        self._period_s = setup.settings.sampling_period_s
        self._values_of_ticks: dict[int, list[Array]] = {}
        agents = tuple(uav_style(owned[0])["color"] for owned in setup.owned)
        uavs = tuple(uav_style(i)["color"] for i in range(setup.system.N))
        ages_s = tuple(periods * self._period_s for periods in _AGE_PERIODS)
        thrusts_N = tuple(share * builder.hover_N for share in _THRUST_OF_HOVER)
        self._quantities = (
            PlottedQuantity("payload error", "m", (_BLACK,), _ERROR_M),
            PlottedQuantity("stage cost", "power of ten", (_BLACK,), _COST_DECADES),
            PlottedQuantity("oldest plan in use, by agent", "s", agents, ages_s),
            PlottedQuantity("thrust, by UAV", "N", uavs, thrusts_N),
        )
        self._whole = whole
        self._ranges = [rounded_range(*quantity.range) for quantity in self._quantities]
        self._plots = [_plot(gui, quantity) for quantity in self._quantities]
        self._set_axis()

    def show_whole(self) -> None:
        """Show the whole recorded time from now on, as the run has ended."""
        self._whole = True
        self._set_axis()

    def show(self, tick: int) -> None:
        """Show the curves of a recorded run, or those until a tick of an active one."""
        ticks = self._ticks(tick)
        origin = 0 if self._whole else tick
        times_s = (np.array(ticks) - origin) * self._period_s
        rows = [self._values(k) for k in ticks]
        for number, plot in enumerate(self._plots):
            curves = np.array([row[number] for row in rows]).T
            self._set_range(number, curves)
            shown_s = (tick - origin) * self._period_s
            plot.data = _with_line(times_s, curves, shown_s, self._ranges[number])

    def _ticks(self, tick: int) -> list[int]:
        """Return the recorded ticks to plot: some hundred, equally spaced, and the last of them."""
        history = self._builder.history
        last = history.last if self._whole else tick
        first = history.first
        if not self._whole:
            first = max(first, tick - round(SPAN_S / self._period_s))
        # Multiples of the spacing, so that the same ticks are drawn again.
        spacing = max(1, -(-(last - first) // _POINTS))
        recorded = history.plant_states
        return [k for k in range(first - first % spacing, last, spacing) if k in recorded] + [last]

    def _values(self, tick: int) -> list[Array]:
        """Return the values of each plot at a tick, computed once: m, power of ten, s, N."""
        if tick not in self._values_of_ticks:
            self._values_of_ticks[tick] = self._computed(tick)
        return self._values_of_ticks[tick]

    def _computed(self, tick: int) -> list[Array]:
        setup, history = self._builder.setup, self._builder.history
        error_m, cost = self._builder.error_and_cost(tick)
        decade = np.log10(max(cost, _LEAST_COST))

        # An agent without a report of this tick, such as a dead one, uses no plan.
        ages_s = np.full(len(setup.agents), np.nan)
        for number, agent in enumerate(setup.agents):
            report = history.reports.get((agent, tick))
            if report is not None:
                ages_s[number] = max([0, *report.plan_ages]) * self._period_s

        thrusts_N = history.plant_states[tick].u[::INPUTS]
        return [np.array([error_m]), np.array([decade]), ages_s, thrusts_N]

    def _set_range(self, number: int, curves: Array) -> None:
        """Change the vertical axis of a plot if its curves leave it or need only a small part."""
        quantity = self._quantities[number]
        finite = curves[np.isfinite(curves)]
        low = float(np.min(finite, initial=quantity.range[0]))
        high = float(np.max(finite, initial=quantity.range[1]))

        present = self._ranges[number]
        fits = present[0] <= low and high <= present[1]
        if not fits or high - low < _LEAST_PART * (present[1] - present[0]):
            self._ranges[number] = rounded_range(low, high)
            self._set_scales(number)

    def _set_scales(self, number: int) -> None:
        """Set fixed axes of a plot: those of uPlot would include the values that stand for gaps."""
        history = self._builder.history
        axis = [-SPAN_S, 0.0]
        if self._whole:
            last = max(history.last, history.first + 1)
            axis = [history.first * self._period_s, last * self._period_s]
        self._plots[number].scales = {
            "x": {"time": False, "auto": False, "range": axis},
            "y": {"auto": False, "range": list(self._ranges[number])},
        }

    def _set_axis(self) -> None:
        """Set and name the axes of all plots."""
        name = "time (s)" if self._whole else "time before the shown instant (s)"
        for number, quantity in enumerate(self._quantities):
            self._set_scales(number)
            self._plots[number].axes = (_axis("x", name), _axis("y", quantity.unit))


def rounded_range(low: float, high: float) -> tuple[float, float]:
    """Return a range with round ends that holds values from `low` to `high` > `low`."""
    decade = 10.0 ** math.floor(math.log10((high - low) / _STEPS))
    step = next(
        decade * factor for factor in (1, 2, 5, 10) if decade * factor * _STEPS >= high - low
    )
    first = math.floor(low / step + _ROUNDING)
    last = math.ceil(high / step - _ROUNDING)
    return first * step, last * step


def _with_line(
    times_s: Array, curves: Array, shown_s: float, axis: tuple[float, float]
) -> tuple[Array, ...]:
    """Return the data of a plot: times, curves, and a vertical line at the shown instant.

    uPlot draws no gaps in arrays of numbers. So values that do not exist lie far above the axis,
    and the line comes from far below it and goes on far above.

    Args:
        times_s: Times of the values, (k,), s.
        curves: Values of the curves, (c, k); not finite where there are none.
        shown_s: Shown instant, s.
        axis: Lower and upper end of the vertical axis.
    """
    low = axis[0] - _FAR * (axis[1] - axis[0])
    high = axis[1] + _FAR * (axis[1] - axis[0])
    curves = np.where(np.isfinite(curves), curves, high)

    place = min(int(np.searchsorted(times_s, shown_s)), len(times_s) - 1)
    beside = curves[:, [place, place]]
    curves = np.insert(curves, [place, place], beside, axis=1)
    times_s = np.insert(times_s, [place, place], [shown_s, shown_s])
    line = np.where(np.arange(len(times_s)) <= place, low, high)
    return (times_s, *map(np.ascontiguousarray, curves), line)


def _plot(gui: Any, quantity: PlottedQuantity) -> Any:
    """Return an empty plot of a quantity."""
    curves = [{"stroke": colour, "width": 1.5} for colour in quantity.colours]
    shown = {"stroke": "#999999", "width": 1.0}
    none = [np.zeros(2) for _ in (*curves, shown)]
    return gui.add_uplot(
        (np.array([-SPAN_S, 0.0]), *none),
        ({"label": "time (s)"}, *curves, shown),
        title=quantity.title,
        legend={"show": False},
        cursor={"show": False},
        height=_HEIGHT_PX,
        padding=_PADDING_PX,
    )


def _axis(axis: str, name: str) -> dict[str, Any]:
    return {
        "label": name,
        "labelSize": _LABEL_PX,
        "labelFont": _FONT,
        "font": _FONT,
        "size": _AXIS_PX[axis],
    }
