"""Curves of an experiment: heights and error bars of hand-made points, and the scale of the vertical axis."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from transport.experiments.cases import Point
from transport.experiments.declaration import Experiment
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
    """Its axis has "never" above the latest time."""
    divergence, *_ = drawn([of(0.002, 0.0)], diverged_s=[2.0, 4.0])
    assert divergence.get_ylim() == pytest.approx((0.0, 1.12 * 1.25 * 4.0))
