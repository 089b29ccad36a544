"""Figures of the comparison: points, intervals, diverged runs, and the maneuvers shown."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy import stats

from transport.experiments.cases import cases_of
from transport.experiments.paper import controllers_and_periods
from transport.experiments.paper.comparison_curves import ComparisonCurve
from transport.experiments.paper.comparison_figures import draw_costs, draw_maneuver
from transport.experiments.paper.controllers_and_periods import (
    AGENT,
    CENTRALIZED,
    GUSTS,
    MANEUVER,
    PAPER,
    SECONDS,
    STEPS,
    STILL,
    TEAM,
    Cell,
)
from transport.experiments.statistics import PointStatistics
from transport.experiments.sweep import Swept
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.style import DIVERGED

AGENTS = 4
PERIOD_S = 0.05
HORIZON = 20
REFERENCE = Cell(CENTRALIZED, PERIOD_S, HORIZON)
GUST_MPS = 0.5
CONFIDENCE = 0.95
DIVERGED_S = 3.5

# Cost over the reference's by period, for each seed, and processor time of an agent per second, for
# each repetition.
Costs = Mapping[float, Sequence[float]]
Loads = Mapping[float, Sequence[float]]
COSTS = {0.1: (1.5, 1.6, 1.7), 0.05: (1.2, 1.1, 1.3), 0.025: (1.0, 1.1, 1.1)}
LOADS = {0.1: (0.03, 0.01, 0.02), 0.05: (0.1, 0.12, 0.3), 0.025: (0.5, 0.4, 0.6)}
OF_REFERENCE = {PERIOD_S: (0.2, 0.21, 0.9)}
REFERENCE_LOAD = 0.21  # the median


def curve(weather: str, controller: str, costs: Costs, loads: Loads) -> ComparisonCurve:
    """Return a curve with made-up costs and processor times."""
    cells = [Cell(controller, period_s, HORIZON) for period_s in costs]
    points = controllers_and_periods.experiment(cells, GUST_MPS).points
    measured = []
    for point, ratios in zip(points, costs.values(), strict=False):
        completed = int(np.isfinite(ratios).sum())
        one = PointStatistics(
            point=point,
            runs=len(ratios),
            completed=completed,
            errors=0,
            diverged_s=(DIVERGED_S,) * (len(ratios) - completed),
            numbers={},
            cost_ratio=None,
        )
        measured.append(one)
    of_agent = np.array(list(loads.values()))
    return ComparisonCurve(
        weather=weather,
        controller=controller,
        kept=STEPS,
        cells=cells,
        measured=measured,
        ratios=np.array(list(costs.values())),
        loads={TEAM: AGENTS * of_agent, AGENT: of_agent},
    )


def compared(by_weather: Mapping[str, Costs], loads: Loads = LOADS) -> list[ComparisonCurve]:
    """Return the curves of the reference and of the paper's algorithm in each weather."""
    curves = []
    for weather, costs in by_weather.items():
        curves.append(curve(weather, CENTRALIZED, {PERIOD_S: (1.0, 1.0, 1.0)}, OF_REFERENCE))
        curves.append(curve(weather, PAPER, costs, loads))
    return curves


def panels_of(curves: Sequence[ComparisonCurve], monkeypatch: pytest.MonkeyPatch) -> list[Axes]:
    """Return the panels of the figure of costs, which is drawn and not written."""
    figures: list[Figure] = []

    def keep(figure: Figure, path: Path) -> list[Path]:
        figures.append(figure)
        return [path]

    monkeypatch.setattr("transport.experiments.paper.comparison_figures.save", keep)
    draw_costs(curves, REFERENCE, Path("unwritten"))
    (figure,) = figures
    return figure.axes


def drawn(panel: Axes) -> list[ErrorbarContainer]:
    """Return the curves of a panel with their intervals, in the order drawn."""
    return [one for one in panel.containers if isinstance(one, ErrorbarContainer)]


def points_of(container: ErrorbarContainer) -> Array:
    """Return the points of a curve, (k, 2)."""
    return np.asarray(container.lines[0].get_xydata())


def heights_of(panel: Axes) -> dict[str, float]:
    """Return the places of the labels at the vertical axis."""
    ticks = panel.yaxis.get_major_ticks()
    return {tick.label1.get_text(): float(tick.get_loc()) for tick in ticks}


def test_a_point_is_the_mean_cost_over_the_median_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Student's interval of the seeds is about it; the time is that of the team, or of an agent."""
    panels = panels_of(compared({STILL: COSTS}), monkeypatch)
    for panel, agents in zip(panels, (AGENTS, 1), strict=True):
        _, paper = drawn(panel)
        times = [agents * sorted(own)[1] for own in LOADS.values()]
        means = [sum(own) / len(own) for own in COSTS.values()]
        assert points_of(paper) == pytest.approx(np.column_stack([times, means]))

        (bars,) = paper.lines[2]
        for bar, time, costs in zip(bars.get_segments(), times, COSTS.values(), strict=True):
            ends = stats.t.interval(
                CONFIDENCE, len(costs) - 1, loc=np.mean(costs), scale=stats.sem(costs)
            )
            assert bar == pytest.approx(np.array([[time, ends[0]], [time, ends[1]]]))


def test_each_budget_and_weather_has_a_panel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A panel has the curves of its weather, and a line at the reference's time of its budget."""
    costs = {STILL: {PERIOD_S: (1.2,)}, GUSTS: {PERIOD_S: (1.6,)}}
    panels = panels_of(compared(costs, {PERIOD_S: (0.1,)}), monkeypatch)
    shown = [(budget, weather) for budget in (TEAM, AGENT) for weather in (STILL, GUSTS)]
    for panel, (budget, weather) in zip(panels, shown, strict=True):
        assert any(f"{weather}, time of {budget}" in text.get_text() for text in panel.texts)
        reference, paper = drawn(panel)
        assert points_of(paper)[:, 1] == pytest.approx([1.2 if weather == STILL else 1.6])
        time = REFERENCE_LOAD * (AGENTS if budget == TEAM else 1)
        assert points_of(reference) == pytest.approx(np.array([[time, 1.0]]))
        (mark,) = (line for line in panel.lines if len(np.asarray(line.get_ydata())) == 2)
        assert mark.get_xdata() == pytest.approx([time, time])


def test_points_with_a_diverged_run_are_drawn_as_diverged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A period with a diverged run has a hollow point at that label, and no cost or interval."""
    none = (math.inf, math.inf, math.inf)
    costs = {0.1: none, 0.05: (1.2, math.inf, 1.3), 0.025: COSTS[0.025]}
    for panel in panels_of(compared({STILL: costs}), monkeypatch):
        _, paper = drawn(panel)
        times, means = points_of(paper).T
        assert np.isnan(means).tolist() == [True, True, False]
        (bars,) = paper.lines[2]
        assert [len(bar) > 0 for bar in bars.get_segments()] == [False, False, True]

        hollow = DIVERGED["markerfacecolor"]
        lines = [line for line in panel.lines if line.get_markerfacecolor() == hollow]
        found = np.vstack([np.asarray(line.get_xydata()) for line in lines])
        height = heights_of(panel)["diverged"]
        assert found == pytest.approx(np.array([[times[0], height], [times[1], height]]))


def test_a_larger_cost_is_at_the_highest_number_of_the_axis(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A cost beyond the axis stays in the panel, below diverged runs; for a low one the axis begins lower."""
    beyond, low = 50.0, 0.5
    costs = {STILL: {PERIOD_S: (beyond,), 0.1: (low,)}}
    for panel in panels_of(compared(costs, {PERIOD_S: (0.1,), 0.1: (0.05,)}), monkeypatch):
        _, paper = drawn(panel)
        heights = heights_of(panel)
        diverged = heights.pop("diverged")
        assert points_of(paper)[:, 1] == pytest.approx([max(heights.values()), low])
        assert panel.get_ylim()[0] == pytest.approx(low)
        assert max(heights.values()) < diverged < panel.get_ylim()[1]


def test_an_interval_ends_at_the_highest_number_of_the_axis(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The part of an interval beyond the axis is cut, and the part below stays where it is."""
    costs = (2.0, 3.0, 5.0)
    lower, upper = stats.t.interval(
        CONFIDENCE, len(costs) - 1, loc=np.mean(costs), scale=stats.sem(costs)
    )
    for panel in panels_of(compared({STILL: {PERIOD_S: costs}}, {PERIOD_S: (0.1,)}), monkeypatch):
        highest = max(value for name, value in heights_of(panel).items() if name != "diverged")
        assert lower < highest < upper
        _, paper = drawn(panel)
        (bars,) = paper.lines[2]
        (bar,) = bars.get_segments()
        assert bar[:, 1] == pytest.approx([lower, highest])
        assert panel.get_ylim()[0] == pytest.approx(lower)  # all of it is in the panel


# Times of an agent at these periods: the second is nearest to the reference's as a ratio, the first
# by their difference; and such that the reference's own period is nearest.
NEAREST_AS_RATIO = {0.1: (0.02,), PERIOD_S: (0.1,), 0.025: (0.35,)}
UNMEASURED = {0.1: (math.nan,), PERIOD_S: (0.1,), 0.025: (0.35,)}  # its runs end before a step
NEAREST_AT_SAME_RATE = {0.1: (0.02,), PERIOD_S: (0.2,), 0.025: (0.5,)}


THREE = [
    ("centralized, 50 ms", CENTRALIZED, 0.05),
    ("paper's algorithm, same rate, 50 ms", PAPER, 0.05),
    ("paper's algorithm, same computation, 25 ms", PAPER, 0.025),
]


@pytest.mark.parametrize(
    ("loads", "expected"),
    [
        (NEAREST_AS_RATIO, THREE),
        (UNMEASURED, THREE),
        (
            NEAREST_AT_SAME_RATE,
            [
                ("centralized, 50 ms", CENTRALIZED, 0.05),
                ("paper's algorithm, same rate and computation, 50 ms", PAPER, 0.05),
            ],
        ),
    ],
    ids=["three", "one is not measured", "two"],
)
def test_maneuvers_at_the_same_rate_and_computation_are_drawn(
    loads: Loads, expected: list[tuple[str, str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are at the reference's period and at that of the least ratio of times, in still air."""
    cells = [REFERENCE, *(Cell(PAPER, period_s, HORIZON) for period_s in loads)]
    experiment = controllers_and_periods.experiment(cells, GUST_MPS)
    cases = cases_of(experiment.points, [MANEUVER], 1)
    swept = Swept(experiment=experiment, cases=cases, results=[])

    found: list[tuple[str, Setup]] = []

    def keep(_: Figure, overlaid: Sequence[tuple[str, Setup, None]], *, shaded: bool) -> None:
        assert shaded
        found.extend((label, setup) for label, setup, _ in overlaid)

    here = "transport.experiments.paper.comparison_figures"
    monkeypatch.setattr(f"{here}.run_in_memory", lambda _: ())
    monkeypatch.setattr(f"{here}.series_of", lambda *_: None)
    monkeypatch.setattr(f"{here}.fill_overlaid", keep)
    monkeypatch.setattr(f"{here}.save", lambda _, path: [path])
    costs = {STILL: COSTS, GUSTS: COSTS}
    draw_maneuver(compared(costs, loads), REFERENCE, swept, Path("unwritten"))

    assert [label for label, _ in found] == [label for label, _, _ in expected]
    for (_, setup), (_, controller, period_s) in zip(found, expected, strict=True):
        assert setup.scenario.name == controllers_and_periods.SCENARIOS[controller]
        assert setup.settings.sampling_period_s == period_s
        assert not any(setup.scenario.plant.wind.gust_mps)


def test_the_legend_tells_the_horizon_of_each_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty steps of 50 ms, or a second, each with its marker and line."""
    panels = panels_of(compared({STILL: COSTS}), monkeypatch)
    (legend,) = panels[0].figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    horizons = {STEPS: "20 steps", SECONDS: "1 s"}
    assert texts == [f"{name}, {horizons[kept]}" for name, kept in controllers_and_periods.CURVES]
    shapes = {
        (text.rpartition(", ")[2], line.get_marker(), line.get_linestyle())
        for text, line in zip(texts, legend.get_lines(), strict=True)
    }
    assert shapes == {("20 steps", "o", "-"), ("1 s", "D", "--")}


def test_ratios_about_one_have_most_of_the_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cost of 0.95 and one of 1.05 are further apart than one of 1.5 and one of 2; the reference is named."""
    panels = panels_of(compared({STILL: COSTS}), monkeypatch)
    assert "line: centralized at 50 ms;" in panels[-1].get_xlabel()
    names = [text.get_text() for text in panels[-1].get_yticklabels()]
    assert names == ["0.95", "1", "1.05", "1.1", "1.2", "1.5", "2", "3", "diverged"]
    for panel in panels:
        (_, at_095), (_, at_105), (_, at_15), (_, at_2) = panel.transData.transform(
            [[1.0, ratio] for ratio in (0.95, 1.05, 1.5, 2.0)]
        )
        assert at_105 - at_095 > at_2 - at_15 > 0.0
        lowest, highest = panel.get_ylim()
        (shade,) = (one for one in panel.patches if isinstance(one, Rectangle))
        assert lowest == 0.88
        # The shade is over the part with another scale.
        assert [shade.get_y(), shade.get_y() + shade.get_height()] == [1.25, highest]
