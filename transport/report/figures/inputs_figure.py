"""Figure of the inputs with their limits, distances of the team, and ages of plans."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import StepReport
from transport.report.figures.column import head, label_ends, limits, widen
from transport.report.figures.curves_over_time import (
    ANGLES,
    LEAST_INPUT,
    LEAST_M,
    WIDE,
    Panels,
    height_of_uavs_in,
    long_legend,
    plot_components,
    plot_uavs,
)
from transport.report.figures.style import line_width
from transport.scene.uav_and_link_colours import uav_style

# Height of a panel, and of a sentence in its place, inches.
_HEIGHT_IN = 0.7
_SENTENCE_IN = 0.01
# Shown distances from obstacles as a multiple of the largest margin.
_NEAR = 6.0

# Ticks and ages of the oldest plan of another agent in use, by agent.
_PlanAges = dict[int, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    """A panel of the figure.

    Attributes:
        title: Its title.
        values: All values shown.
        least: Changes of the values below it are not shown.
        unit: Their unit.
        draw: Draws it, and returns its panels.
        height_in: Its height, inches.
        always: Whether it is drawn even if it is flat: a figure has a panel with curves.
    """

    title: str
    values: Array
    least: float
    unit: str
    draw: Callable[[Axes], Sequence[Axes]]
    height_in: float = _HEIGHT_IN
    always: bool = False

    @property
    def is_flat(self) -> bool:
        """True if a sentence says all that the panel would show."""
        return not self.always and bool(np.ptp(self.values) <= self.least)

    def write(self, panel: Axes) -> None:
        """Write the sentence in place of the panel."""
        middle = float(np.median(self.values))
        about = 0.0 if abs(middle) < self.least else middle
        panel.set_axis_off()
        name, _, _ = self.title.partition(" (")
        head(panel, f"{name}: {about:.3g} {self.unit} throughout", legend=False)


def draw_inputs(setup: Setup, log: RunLog, series: Series, panels_of: Panels) -> list[Axes]:
    """Draw inputs, separation, distance from obstacles and age of plans.

    Panels without data are left out. A sentence stands for curves that do not change.

    Returns: The panels with curves.
    """
    parts = [*_inputs(setup, series), *_distances(setup, series), *_plan_age(setup, log)]
    flat = [part for part in parts if part.is_flat]
    drawn = [part for part in parts if not part.is_flat]
    # The last panel has the axis of time: sentences stand above it.
    order = [*drawn[:-1], *flat, drawn[-1]]
    heights_in = [_SENTENCE_IN if part in flat else part.height_in for part in order]
    panels = panels_of(heights_in, legend=long_legend(setup))
    with_curves: list[Axes] = []
    for part, panel in zip(order, panels, strict=True):
        if part in flat:
            part.write(panel)
        else:
            with_curves += part.draw(panel)
    return with_curves


def _plan_age(setup: Setup, log: RunLog) -> Iterator[_Part]:
    """Yield the panel of the ages of plans, if any plan is used."""
    plan_ages = _plan_ages(log)
    if not plan_ages:
        return
    period_s = setup.settings.sampling_period_s
    ages_s = [period_s * age for entries in plan_ages.values() for _, age in entries]
    yield _Part(
        title="oldest plan used (s)",
        values=np.array(ages_s),
        least=0.0,
        unit="s",
        draw=partial(_draw_plan_ages, setup=setup, plan_ages=plan_ages),
    )


def _plan_ages(log: RunLog) -> _PlanAges:
    """Return ticks and ages of the oldest plan in use, of agents that use any."""
    ages: _PlanAges = {}
    for report in log.of(StepReport):
        oldest = max(report.plan_ages, default=-1)
        if oldest >= 0:
            ages.setdefault(report.agent, []).append((report.tick, oldest))
    return ages


def _inputs(setup: Setup, series: Series) -> Iterator[_Part]:
    """Yield the panel of each kind of input of the UAVs."""
    is_rate = setup.system.commands_rates
    turning = "rate command (rad/s)" if is_rate else "moment (N m)"
    names = ("thrust (N)", *(f"{axis} {turning}" for axis in ANGLES))
    units = ("N", *(["rad/s" if is_rate else "N m"] * len(ANGLES)))
    lower = setup.settings.lower(1)
    upper = setup.settings.upper(1)
    for k, name in enumerate(names):
        is_thrust = k == 0
        is_symmetric = lower[k] == -upper[k]
        bounds = f"± {upper[k]:g}" if is_symmetric else f"{lower[k]:g}, {upper[k]:g}"
        title = f"{name}, limits {bounds}"
        yield _Part(
            title=title,
            values=series.u[:, k::INPUTS],
            least=LEAST_INPUT,
            unit=units[k],
            height_in=height_of_uavs_in(setup, _HEIGHT_IN),
            always=is_thrust,
            draw=partial(
                _draw_limited,
                title=title,
                series=series,
                k=k,
                ends=(float(lower[k]), float(upper[k])),
            ),
        )


def _draw_limited(
    panel: Axes, title: str, series: Series, k: int, ends: tuple[float, float]
) -> Sequence[Axes]:
    """Draw an input of the UAVs with its limits."""
    panels = plot_uavs(panel, series.times_s, series.u[:, k::INPUTS])
    for one in panels:
        _widen_about_middle(one, LEAST_INPUT)
        limits(one, *ends)
        if len(panels) > 1:
            label_ends(one)
    head(panels[0], title, legend=ends[0] != -ends[1])
    return panels


def _distances(setup: Setup, series: Series) -> Iterator[_Part]:
    """Yield the panels of the smallest distance between UAVs and of those from obstacles."""
    if setup.system.N > 1:
        title = "smallest distance between UAVs (m)"
        separation = setup.settings.separation
        if separation is not None:
            title += f", limit {separation.minimum_m:g}"
        yield _Part(
            title=title,
            values=series.separation_m,
            least=LEAST_M,
            unit="m",
            draw=partial(_draw_separation, title=title, setup=setup, series=series),
        )
    if setup.obstacles:
        yield _Part(
            title="distance from obstacles (m)",
            values=series.clearance_m,
            least=0.0,
            unit="m",
            draw=partial(_draw_clearance, setup=setup, series=series),
        )


def _draw_separation(panel: Axes, title: str, setup: Setup, series: Series) -> Sequence[Axes]:
    """Draw the smallest distance between UAVs, from its limit on if there is one, else from contact on."""
    panel.plot(series.times_s, series.separation_m, color="#000000")
    _widen_about_middle(panel, LEAST_M)
    separation = setup.settings.separation
    widen(panel, 0.0 if separation is None else separation.minimum_m, -np.inf)
    if separation is not None:
        limits(panel, separation.minimum_m)
    head(panel, title)
    return [panel]


def _draw_clearance(panel: Axes, setup: Setup, series: Series) -> Sequence[Axes]:
    """Draw the smallest distances from obstacles, with their margins."""
    plot_components(panel, series.times_s, series.clearance_m, ("UAVs", "rods", "payload"))
    margins_m = {obstacle.margin_m for obstacle in setup.obstacles}
    margins_m |= {obstacle.load_margin_m for obstacle in setup.obstacles}
    deepest_m = min(0.0, float(series.clearance_m.min()))  # negative within an obstacle
    # Lines of limits are drawn within the range of the axis.
    panel.set_ylim(deepest_m, _NEAR * max(margins_m))
    limits(panel, *sorted(margins_m))
    head(panel, "distance from obstacles (m)")
    return [panel]


def _draw_plan_ages(panel: Axes, setup: Setup, plan_ages: _PlanAges) -> Sequence[Axes]:
    """Draw the age of the oldest plan that each agent uses."""
    period_s = setup.settings.sampling_period_s
    for i, (agent, entries) in enumerate(sorted(plan_ages.items())):
        times_s, ages_s = period_s * np.array(entries).T
        style = uav_style(setup.owned[agent - 1][0])
        style |= {"linewidth": line_width(i, len(plan_ages), WIDE)}
        label = f"agent {agent}" if i == 0 else str(agent)
        panel.plot(times_s, ages_s, label=label, **style)
    widen(panel, 0.0, period_s)
    head(panel, "oldest plan used (s)")
    return [panel]


def _widen_about_middle(panel: Axes, least: float) -> None:
    """Let an axis show at least a range about its middle."""
    middle = sum(panel.get_ylim()) / 2.0
    widen(panel, middle - least, middle + least)
