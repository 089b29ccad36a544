"""Curves of an experiment: heights and error bars of hand-made points, and the scale of the vertical axis."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from transport.experiments.cases import Point
from transport.experiments.declaration import NONE, Experiment
from transport.experiments.figures.curves_of_experiment import curves_of
from transport.experiments.figures.figure_curves import draw_curves
from transport.experiments.statistics import Estimate, PointStatistics

# Values of five seeds or more have their interval as error bar.
SEEDS = 8
LABEL, STEP = "std_s", 0.1


def of(mean: float, half_width: float) -> Estimate:
    """Return an estimate whose values are all positive."""
    return Estimate(mean=mean, half_width=half_width, n=SEEDS, low=0.5 * mean, high=2.0 * mean)


def drawn(costs: Sequence[Estimate], diverged_s: Sequence[float] = ()) -> list[Axes]:
    """Return the panels of points at 0, 100, 200, ... ms with costs, and attitudes of 1 deg."""
    points = [
        PointStatistics(
            point=Point(labels={LABEL: STEP * k}, text=""),
            runs=SEEDS,
            completed=SEEDS,
            errors=0,
            diverged_s=tuple(diverged_s),
            numbers={"cost_mean": cost, "attitude_max_deg": of(1.0, 0.1)},
            cost_ratio=None,
        )
        for k, cost in enumerate(costs)
    ]
    figure = Figure()
    draw_curves(figure, Experiment(name="test", x=LABEL), {"paper": points})
    return figure.axes


def curve(panel: Axes) -> tuple[list[float], np.ndarray[Any, Any]]:
    """Return the heights of the one curve of a panel, and the ends of its error bars, (points, 2)."""
    (container,) = panel.containers
    assert isinstance(container, ErrorbarContainer)
    line, _, (bars,) = container.lines
    assert line is not None
    ends = np.array(bars.get_segments())[:, :, 1]
    return np.asarray(line.get_ydata()).tolist(), ends


def test_means_and_intervals_stand_at_their_values() -> None:
    """Costs are in thousandths, attitudes in degrees; an interval goes no further than to zero."""
    cost, attitude = drawn([of(0.002, 0.0005), of(0.003, 0.004)])
    heights, bars = curve(cost)
    assert heights == pytest.approx([2.0, 3.0])
    assert bars == pytest.approx(np.array([[1.5, 2.5], [0.0, 7.0]]))
    heights, bars = curve(attitude)
    assert heights == pytest.approx([1.0, 1.0])
    assert bars == pytest.approx(np.array([[0.9, 1.1]] * 2))


@pytest.mark.parametrize(
    ("costs", "scale", "limits"),
    [
        ([of(0.002, 0.0), of(0.003, 0.0)], "linear", (0.0, 1.12 * 3.0)),
        ([of(0.002, 0.0), of(0.003, 0.4)], "linear", (0.0, 2.0 * 3.0)),  # the bar leaves the panel
        ([of(0.0, 0.0), of(0.0, 0.0)], "linear", (0.0, 1.0)),
        ([of(0.001, 0.0)] * 3 + [of(0.007, 0.0)], "log", (1.0 / 1.4, 7.0 * 1.4)),
        ([of(0.001, 0.0)] * 3 + [of(0.004, 0.0)], "linear", (0.0, 1.12 * 4.0)),
    ],
)
def test_the_vertical_axis_fits_the_means(
    costs: Sequence[Estimate], scale: str, limits: tuple[float, float]
) -> None:
    """It begins at zero and has all means in it; few that are over five times the median make it logarithmic."""
    cost, _ = drawn(costs)
    assert cost.get_yscale() == scale
    assert cost.get_ylim() == pytest.approx(limits)


def test_diverged_runs_have_a_panel_before_the_others() -> None:
    """Its axis has "never" above the latest time: a full mark there, a hollow one at the mean, and the range."""
    divergence, *_ = drawn([of(0.002, 0.0)], diverged_s=[2.0, 2.5, 4.0])
    never_s = 1.25 * 4.0
    assert divergence.get_ylim() == pytest.approx((0.0, 1.12 * never_s))
    lines = [np.ravel(line.get_ydata()).tolist() for line in divergence.get_lines()]
    assert lines == [[never_s], [2.0, 4.0], [pytest.approx(8.5 / 3.0)]]
    colours = [line.get_markerfacecolor() == "#ffffff" for line in divergence.get_lines()]
    assert colours == [False, False, True]
    ticks = dict(zip(divergence.get_yticks(), divergence.get_yticklabels(), strict=True))
    assert max(ticks) == never_s
    assert ticks[never_s].get_text() == "never"


def test_a_panel_of_flat_curves_is_low_and_growth_is_logarithmic() -> None:
    """Attitudes that do not change take half an inch; processor times have decades, however close they are."""
    cost, attitude = drawn([of(0.002, 0.0), of(0.003, 0.0)])
    assert cost.get_position().height / attitude.get_position().height == pytest.approx(0.95 / 0.5)
    # Within a hundredth of the largest, or beyond.
    for lower, height_in in ((99.005, 0.5), (98.9, 0.95)):
        figure = Figure()
        own = [point(0.0, 100.0), point(STEP, lower)]
        draw_curves(figure, Experiment(name="test", x=LABEL), {"paper": own})
        heights = [panel.get_position().height for panel in figure.axes]
        assert heights[0] / heights[1] == pytest.approx(height_in / 0.5)

    names = ("cpu_step_p50_ms", "cpu_team_tick_ms", "plan_bytes_per_s", "cost_mean")
    team = point(2.0, 1.0)
    grown = [
        replace(
            team,
            point=Point(labels={"uavs": float(uavs)}, text=""),
            numbers={name: Estimate(uavs, None, 1, uavs, uavs) for name in names},
        )
        for uavs in (2.0, 3.0)
    ]
    figure = Figure()
    draw_curves(figure, Experiment(name="test", x="uavs", drawn_as="scaling"), {"paper": grown})
    assert [panel.get_yscale() for panel in figure.axes] == ["log"] * 4
    assert figure.axes[0].get_xscale() == "log"


def test_many_scenarios_share_their_panels() -> None:
    """Of four, each with its name in the legend."""
    figure = Figure()
    own = [point(STEP * k, 3.0) for k in range(3)]
    names = ("paper", "resilient", "precise", "alone")
    draw_curves(figure, Experiment(name="test", x=LABEL), dict.fromkeys(names, own))
    assert len(figure.axes) == 2
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(names)


def point(x: float | str, cost: float, curve: str = "none", runs: int = 1) -> PointStatistics:
    """Return a point of a curve whose runs all have a cost, thousandths, and an attitude of 1 deg."""
    cost = 1e-3 * cost
    spread = None if runs == 1 else 0.5 * cost
    numbers = {"cost_mean": cost, "attitude_max_deg": 1.0}
    return PointStatistics(
        point=Point(labels={LABEL: x, "model": curve}, text=""),
        runs=runs,
        completed=runs,
        errors=0,
        diverged_s=(),
        numbers={
            name: Estimate(mean, spread, runs, 0.2 * mean, 2.0 * mean)
            for name, mean in numbers.items()
        },
        cost_ratio=None,
    )


def test_two_scenarios_have_columns_of_panels_with_the_same_axis() -> None:
    """Equal curves of two scenarios cannot hide each other; names are above, the legend has none."""
    figure = Figure()
    own = [point(STEP * k, 3.0) for k in range(3)]
    draw_curves(figure, Experiment(name="test", x=LABEL), {"paper": own, "resilient": own})
    cost, other_cost, *_ = figure.axes
    assert curve(cost)[0] == curve(other_cost)[0] == pytest.approx([3.0] * 3)
    assert cost.get_ylim() == other_cost.get_ylim()
    assert cost.get_position().x1 < other_cost.get_position().x0
    assert [cost.texts[0].get_text(), other_cost.texts[0].get_text()] == ["paper", "resilient"]
    assert not figure.legends


def test_equal_curves_of_a_scenario_stand_beside_each_other() -> None:
    """At each value, which then has its name and no place of its own on the axis."""
    figure = Figure()
    own = [point(STEP * k, 3.0, name) for k in range(3) for name in ("a", "b")]
    draw_curves(figure, Experiment(name="test", x=LABEL, curves="model"), {"paper": own})
    cost, *_, last = figure.axes
    first, second = (
        np.asarray(one.lines[0].get_xdata())
        for one in cost.containers
        if isinstance(one, ErrorbarContainer) and one.lines[0] is not None
    )
    assert second - first == pytest.approx([0.07] * 3)  # of a distance of 1 between values
    assert (first + second) / 2.0 == pytest.approx([0.0, 1.0, 2.0])
    assert [text.get_text() for text in last.get_xticklabels()] == ["0", "100", "200"]


def test_bars_stay_within_a_logarithmic_axis() -> None:
    """Three runs have their range as bar, and the label below tells so."""
    figure = Figure()
    costs = (1.0, 1.0, 1.0, 10.0)
    own = [point(STEP * k, cost, runs=3) for k, cost in enumerate(costs)]
    draw_curves(figure, Experiment(name="test", x=LABEL), {"paper": own})
    cost, *_, last = figure.axes
    low, high = cost.get_ylim()
    assert cost.get_yscale() == "log"
    assert low < 0.2 * costs[0]
    assert high > 2.0 * costs[-1]
    assert last.get_xlabel().endswith("\nbars: range of 3 runs")


def test_points_of_no_curve_belong_to_all() -> None:
    """Of two at one place the last one counts: with a mean delay the constant delay, not the perfect network."""
    labels = [(NONE, 0.0), (NONE, 0.0), ("uniform", 0.1), ("normal", 0.1), ("normal", 0.2)]
    points = [
        PointStatistics(
            point=Point(labels={"distribution": name, LABEL: x}, text=f"{number}"),
            runs=SEEDS,
            completed=SEEDS,
            errors=0,
            diverged_s=(),
            numbers={},
            cost_ratio=None,
        )
        for number, (name, x) in enumerate(labels)
    ]
    experiment = Experiment(name="test", x=LABEL, curves="distribution")
    curves = list(curves_of(experiment, {"paper": points}, joined=True))
    texts = {curve.style["label"]: [one.point.text for one in curve.points] for curve in curves}
    assert texts == {"uniform": ["1", "2"], "normal": ["1", "3", "4"]}
    of_two = list(curves_of(experiment, {"paper": points, "resilient": points}, joined=False))
    assert of_two[0].style["label"] == "paper, uniform"
    assert of_two[0].style["color"] == of_two[1].style["color"] != of_two[2].style["color"]
    assert of_two[0].style["linestyle"] == ""


@pytest.mark.parametrize(
    ("drawn_as", "numbers"),
    [
        ("curves", {"cost_mean": 1e3, "attitude_max_deg": 1.0}),
        ("sharing", {"plans_shared_share": 100.0, "cost_ratio": 1.0, "attitude_max_deg": 1.0}),
        (
            "radio",
            {"air_delivered_share": 100.0, "airtime_share": 100.0, "payload_rms_m": 100.0, "cost_ratio": 1.0},
        ),
        ("age", {"payload_rms_m": 100.0, "attitude_max_deg": 1.0}),
        (
            "scaling",
            {"cpu_step_p50_ms": 1.0, "cpu_team_tick_ms": 1.0, "plan_bytes_per_s": 1e-3, "cost_mean": 1e3},
        ),
    ],
)  # fmt: skip
def test_each_panel_has_its_number_in_its_unit(drawn_as: Any, numbers: dict[str, float]) -> None:
    """From above, for each kind of experiment: shares in percent, costs in thousandths, errors in cm, plans in kB."""
    values = {name: 0.1 * (k + 2) for k, name in enumerate(numbers)}
    estimates = {name: Estimate(value, None, 1, value, value) for name, value in values.items()}
    estimates.setdefault("cost_mean", Estimate(0.5, None, 1, 0.5, 0.5))  # of which a ratio is one
    points = [
        PointStatistics(
            point=Point(labels={LABEL: STEP * (k + 1)}, text=""),
            runs=1,
            completed=1,
            errors=0,
            diverged_s=(),
            numbers=estimates,
            cost_ratio=values.get("cost_ratio"),
        )
        for k in range(2)
    ]
    figure = Figure()
    experiment = Experiment(name="test", x=LABEL, drawn_as=drawn_as)
    draw_curves(figure, experiment, {"paper": points})
    heights = [np.asarray(panel.containers[0].lines[0].get_ydata())[0] for panel in figure.axes]  # type: ignore[attr-defined]
    assert heights == pytest.approx([values[name] * factor for name, factor in numbers.items()])


def test_three_scenarios_have_columns_and_what_they_have_in_common_is_the_legend() -> None:
    """Curves of the same name are one entry without the name of a scenario and its colour."""
    figure = Figure()
    own = [point(STEP * k, 3.0, name) for k in range(3) for name in ("a", "b")]
    names = ("paper", "resilient", "precise")
    experiment = Experiment(name="test", x=LABEL, curves="model")
    draw_curves(figure, experiment, dict.fromkeys(names, own))
    assert [panel.texts[0].get_text() for panel in figure.axes[:3]] == list(names)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
    assert len({str(line.get_color()) for line in legend.get_lines()}) == 1

    figure = Figure()
    draw_curves(figure, replace(experiment, drawn_as="age"), dict.fromkeys(names, rms(own)))
    (legend,) = figure.legends
    assert len(figure.axes) == 2  # other kinds have one column
    assert len(legend.get_texts()) == 6


def rms(points: Sequence[PointStatistics]) -> list[PointStatistics]:
    """Return points with an error of the payload, too."""
    error = Estimate(0.02, None, 1, 0.02, 0.02)
    return [replace(one, numbers={**one.numbers, "payload_rms_m": error}) for one in points]


def test_a_point_of_which_no_run_completes_has_no_mark_at_never() -> None:
    """It has the mean of its times alone."""
    figure = Figure()
    none = replace(point(0.0, 1.0), completed=0, diverged_s=(2.0, 3.0), numbers={
        "cost_mean": None, "attitude_max_deg": None,
    })  # fmt: skip
    draw_curves(figure, Experiment(name="test", x=LABEL), {"paper": [none, point(STEP, 1.0)]})
    lines = [
        (*np.ravel(line.get_xdata()), *np.ravel(line.get_ydata()))
        for line in figure.axes[0].get_lines()
    ]
    at_never = [line for line in lines if line[-1] == pytest.approx(1.25 * 3.0)]
    assert len(at_never) == 1
    assert len(lines) == 3
