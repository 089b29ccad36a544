"""Figures of hand-made points: places, colours and texts of the arena's cells, of maps, rows and weathers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from transport.experiments.cases import Point
from transport.experiments.figures.axes_and_units import Axis
from transport.experiments.figures.colour_scale import scale_of
from transport.experiments.figures.figure_arena import CellLayout, draw_arena, draw_measure
from transport.experiments.figures.figure_maps import draw_maps
from transport.experiments.figures.figure_variants import draw_tracking, draw_variants
from transport.experiments.figures.figure_weather import draw_weather
from transport.experiments.statistics import Estimate, PointStatistics
from transport.experiments.weather_experiment import NETWORKS

RUNS = 4


def point(
    labels: Mapping[str, str | float],
    numbers: Mapping[str, float | None] = MappingProxyType({}),
    *,
    completed: int = RUNS,
    diverged_s: Sequence[float] = (),
    ratio: float | None = None,
) -> PointStatistics:
    """Return a point of four runs, in which each number has the same value, or none."""
    estimates = {
        name: None if value is None else Estimate(value, 0.0, RUNS, value, value)
        for name, value in numbers.items()
    }
    return PointStatistics(
        point=Point(labels=labels, text=""),
        runs=RUNS,
        completed=completed,
        errors=0,
        diverged_s=tuple(diverged_s),
        numbers=estimates,
        cost_ratio=ratio,
    )


def flown(network: str, algorithm: str, completed: int, error_m: float) -> PointStatistics:
    """Return a point of the arena with a payload error; without a completed run it has none."""
    labels = {"task": "gusts", "network": network, "algorithm": algorithm}
    return point(labels, {"payload_rms_m": error_m if completed else None}, completed=completed)


# Scales


@pytest.mark.parametrize(
    ("numbers", "decades", "ends"),
    [
        ([0.02, 0.0, 4.0], None, (0.02, 4.0)),
        ([0.002, 40.0], 3.0, (0.04, 40.0)),  # no more than three decades
        ([5.0, 5.0], None, (5.0, 5.005)),
        ([0.0], None, (1.0, 1.001)),
    ],
)
def test_a_scale_holds_all_numbers_above_zero(
    numbers: list[float], decades: float | None, ends: tuple[float, float]
) -> None:
    """Its ends are the least and the largest number, as far as the decades allow, and always differ."""
    scale = scale_of(numbers, decades)
    assert (scale.vmin, scale.vmax) == pytest.approx(ends)


# Arena


def test_networks_have_their_places_in_a_cell() -> None:
    """Three networks stand in two rows, 0.44 of a cell apart, about its middle; a tile has 0.9 of its place."""
    layout = CellLayout(["perfect", "late", "radio"])
    assert layout.rows == [["perfect", "late"], ["radio"]]
    places = [layout.place(network) for network in layout.networks]
    assert np.array(places) == pytest.approx(
        np.array([[-0.22, -0.22], [0.22, -0.22], [-0.22, 0.22]])
    )
    assert layout.tile == pytest.approx((0.396, 0.396))
    assert CellLayout(["perfect"]).place("perfect") == (0.0, 0.0)


def test_marks_of_the_arena_tell_how_many_runs_complete() -> None:
    """Full for all, half for some, hollow for none, each at its algorithm and network."""
    figure = Figure()
    draw_arena(
        figure,
        [
            flown("perfect", "paper", RUNS, 0.1),
            flown("late", "paper", 1, 0.1),
            flown("perfect", "alone:Alone", 0, 0.1),
        ],
    )
    (panel,) = figure.axes
    edges = 4 + 1  # lines between the cells of one row and two columns
    marks = [
        (line.get_fillstyle(), *np.ravel(line.get_xdata()), *np.ravel(line.get_ydata()))
        for line in panel.get_lines()[edges:]
    ]
    assert marks == [("full", 0.0, -0.22), ("left", 0.0, 0.22), ("none", 1.0, -0.22)]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["paper", "Alone"]


@pytest.mark.parametrize(
    ("networks", "rows"),
    [
        (["perfect"], [["perfect"]]),
        (["perfect", "late", "bursts"], [["perfect", "late", "bursts"]]),
        (
            ["perfect", "late", "bursts", "radio", "none"],
            [["perfect", "late", "bursts", "radio"], ["no network"]],
        ),
    ],
)
def test_the_legend_of_the_arena_has_networks_first_and_fills_last(
    networks: Sequence[str], rows: Sequence[Sequence[str]]
) -> None:
    """Four entries fit beside each other; networks are full marks, and each fill has its meaning."""
    figure = Figure()
    draw_arena(figure, [flown(network, "paper", RUNS, 0.1) for network in networks])
    figure.draw_without_rendering()

    (legend,) = figure.legends
    shown: dict[float, list[tuple[float, str, str]]] = {}
    for handle, text in zip(legend.get_lines(), legend.get_texts(), strict=True):
        if text.get_text():
            right, up = text.get_window_extent().p0
            row = shown.setdefault(round(up), [])
            row.append((right, text.get_text(), str(handle.get_fillstyle())))
    found = [[entry[1:] for entry in sorted(shown[up])] for up in sorted(shown, reverse=True)]
    fills = [("all complete", "full"), ("some do", "left"), ("none does", "none")]
    assert found == [*[[(name, "full") for name in row] for row in rows], fills]


def test_the_title_of_a_measure_tells_the_order_of_the_networks() -> None:
    """A line for the rows of a cell; a single network needs none."""
    titles = []
    for networks in (["perfect"], ["late", "perfect"], ["late", "perfect", "radio"]):
        figure = Figure()
        measured = [flown(network, "paper", RUNS, 0.01) for network in networks]
        draw_measure(figure, measured, "payload_rms_m", "payload error, cm", 100.0)
        titles.append(figure.axes[0].texts[0].get_text())
    assert titles == [
        "payload error, cm",
        "payload error, cm\nin a cell: perfect / late",
        "payload error, cm\nin a cell: perfect, late / radio",
    ]


@pytest.mark.parametrize(
    ("ratio", "completed", "tiles", "numbers"),
    [(1.5, RUNS, 1, ["1.5"]), (None, 0, 1, ["1"])],
    ids=["one number", "none"],
)
def test_a_scale_of_one_number_has_it_alone(
    ratio: float | None, completed: int, tiles: int, numbers: list[str]
) -> None:
    """A ratio of costs is one of the points themselves; without any number the scale is one of 1."""
    figure = Figure()
    one = replace(flown("perfect", "paper", completed, 0.1), cost_ratio=ratio)
    draw_measure(figure, [one], "cost_ratio", "cost over centralized", 1.0)
    panel, bar = figure.axes
    assert len([patch for patch in panel.patches if isinstance(patch, Rectangle)]) == tiles
    assert bool(panel.patches[0].get_hatch()) is (ratio is None)
    assert [label.get_text() for label in bar.get_yticklabels()] == numbers


def test_a_mean_of_zero_has_no_tile() -> None:
    """A logarithmic scale has no zero, and the runs have completed: no colour and no hatches."""
    figure = Figure()
    measured = [flown("perfect", "paper", RUNS, 0.02), flown("perfect", "alone", RUNS, 0.0)]
    draw_measure(figure, measured, "payload_rms_m", "payload error, cm", 100.0)
    (tile,) = (patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle))
    assert tile.get_x() == pytest.approx(-0.396)


def test_tiles_of_the_arena_have_the_colour_of_their_number() -> None:
    """In the unit of the figure; hatched where no run completes, and the bar names ends and middle."""
    figure = Figure()
    measured = [
        flown("perfect", "paper", RUNS, 0.01),
        flown("perfect", "resilient", RUNS, 0.04),
        flown("perfect", "alone", 0, 0.0),
    ]
    draw_measure(figure, measured, "payload_rms_m", "payload error, cm", 100.0)
    panel, bar = figure.axes
    low, high, none = (patch for patch in panel.patches if isinstance(patch, Rectangle))
    colours = mpl.colormaps[mpl.rcParams["image.cmap"]]
    assert low.get_facecolor() == pytest.approx(colours(0.0))
    assert high.get_facecolor() == pytest.approx(colours(1.0))
    assert none.get_hatch()
    assert low.get_xy() == pytest.approx((-0.396, -0.198))
    assert (low.get_width(), low.get_height()) == pytest.approx((0.792, 0.396))
    assert [label.get_text() for label in bar.get_yticklabels()] == ["1", "2", "4"]


# Maps

DELAY = Axis("delay_s", "delay", "ms", 1e3)
LOSS = Axis("loss", "loss", "%", 100.0)
COST = Axis("cost_mean", "mean cost", "$10^{-3}$", 1e3)


def test_a_map_writes_each_number_in_its_cell() -> None:
    """Columns and rows increase; some runs or none are told, and a hatched cell says when the first ends."""
    figure = Figure()
    measured = [
        point({"delay_s": 0.2, "loss": 0.3}, {"cost_mean": 0.0121}, completed=3),
        point({"delay_s": 0.0, "loss": 0.0}, {"cost_mean": 0.002}),
        point(
            {"delay_s": 0.2, "loss": 0.0}, {"cost_mean": None}, completed=0, diverged_s=[4.25, 7.0]
        ),
    ]
    draw_maps(figure, DELAY, LOSS, COST, {"paper": measured})
    panel = figure.axes[0]
    texts = {text.get_position(): text.get_text() for text in panel.texts}
    assert texts[0, 0] == "2.00"
    assert texts[1, 1] == "12.1\n3 of 4"
    assert texts[1, 0] == "ends at\n4.2 s"
    assert panel.get_ylabel() == "loss (%)"
    assert [label.get_text() for label in panel.get_xticklabels()] == ["0", "200"]
    assert [label.get_text() for label in panel.get_yticklabels()] == ["0", "30"]
    colours = panel.get_images()[0].get_array()
    assert np.ma.filled(np.ma.asarray(colours), 0.0) == pytest.approx(
        np.array([[2.0, 0.0], [0.0, 12.1]])
    )


def test_named_rows_of_a_map_have_their_order_from_the_top() -> None:
    """Maps of all scenarios have one scale of colours, on which numbers are white where it is dark."""
    figure = Figure()
    network = Axis("network", "network")
    lowest, highest = (
        [
            point({"delay_s": 0.0, "network": name}, {"cost_mean": cost})
            for name in ("radio", "late")
        ]
        for cost in (0.002, 0.2)
    )
    draw_maps(figure, DELAY, network, COST, {"paper": lowest, "resilient": highest})
    dark, bright, bar = figure.axes
    for panel, colour, text in ((dark, "#ffffff", "2.00"), (bright, "#000000", "200.0")):
        assert [label.get_text() for label in panel.get_yticklabels()] == ["radio", "late"]
        low, high = panel.get_ylim()
        assert low > high  # row 0 is at the top
        assert panel.get_ylabel() == ""  # names say by themselves what they are
        numbers = [one for one in panel.texts if one.get_text() == text]
        assert [one.get_color() for one in numbers] == [colour] * 2
    assert bar.get_ylim() == pytest.approx((2.0, 200.0))


def test_a_distance_stands_in_a_map_only_if_all_runs_complete() -> None:
    """That of the other runs would say little: the cell tells how many complete."""
    figure = Figure()
    labels = {"delay_s": 0.0, "loss": 0.0}
    shown = Axis("separation_min_m", "distance", "m")
    draw_maps(
        figure, DELAY, LOSS, shown, {"paper": [point(labels, {shown.label: 0.4}, completed=3)]}
    )
    assert [text.get_text() for text in figure.axes[0].texts] == ["3 of 4", "paper"]


# Rows


def test_networks_of_a_variant_stand_about_its_row() -> None:
    """Half a row apart, at their cost over the baseline's; diverged runs are marked beside the panel."""
    figure = Figure()
    measured = [
        point(
            {"network": network, "part": "preview", "value": "false"}, ratio=ratio, completed=done
        )
        for network, ratio, done in (("perfect", 1.2, RUNS), ("late", 1.5, 3))
    ]
    draw_variants(figure, {"paper": measured})
    (panel,) = figure.axes
    marks = [
        (*np.ravel(line.get_xdata()), *np.ravel(line.get_ydata())) for line in panel.get_lines()
    ]
    assert marks[:3] == [(1.2, -0.25), (1.5, 0.25), (1.0, 0.25)]
    assert marks[3:] == [(1.0, 1.0, 0.0, 1.0)]  # the baseline, over the whole height
    assert panel.get_ylim() == (0.5, -0.5)  # the first variant is at the top
    assert [label.get_text() for label in panel.get_yticklabels()] == ["preview: false"]
    assert panel.get_xlim() == pytest.approx((1.0 / 1.15, 1.5 * 1.15))


def test_tracking_shows_three_numbers_beside_each_other() -> None:
    """In cm and degrees, a row for each case and a mark for each speed; axes end above the highest value."""
    figure = Figure()
    speed = Axis("speed_mps", "largest speed", "m/s")
    numbers = {"payload_rms_m": 0.02, "payload_max_m": 0.05, "attitude_max_deg": 7.0}
    measured = [
        point({"case": case, "speed_mps": mps}, numbers)
        for case in ("late", "wind")
        for mps in (3.0, 5.0)
    ]
    draw_tracking(figure, measured, speed, "case")
    (whole,) = figure.axes
    panels = whole.child_axes
    assert [panel.get_xlim()[1] for panel in panels] == pytest.approx([2.2, 5.5, 7.7])
    rows = [float(np.ravel(line.get_ydata())[0]) for line in panels[0].get_lines()]
    assert rows == pytest.approx([-0.25, 0.25, 0.75, 1.25])
    assert [label.get_text() for label in panels[0].get_yticklabels()] == ["late", "wind"]


def test_the_axis_of_errors_ends_above_their_bars() -> None:
    """The interval of eight runs is a bar of its length about the mean."""
    figure = Figure()
    speed = Axis("speed_mps", "largest speed", "m/s")
    one = point(
        {"case": "wind", "speed_mps": 3.0}, {"payload_max_m": 0.05, "attitude_max_deg": 7.0}
    )
    interval = Estimate(mean=0.02, half_width=0.01, n=8, low=0.0, high=0.1)
    draw_tracking(
        figure, [replace(one, numbers={**one.numbers, "payload_rms_m": interval})], speed, "case"
    )
    panel, *_ = figure.axes[0].child_axes
    assert panel.get_xlim() == pytest.approx((0.0, 1.1 * 3.0))
    (container,) = panel.containers
    assert isinstance(container, ErrorbarContainer)
    (bar,) = container.lines[2][0].get_segments()
    assert bar[:, 0] == pytest.approx([1.0, 3.0])


# Weather


def test_controllers_stand_beside_each_other_and_one_without_network_is_a_line() -> None:
    """Errors, m, stand about their networks; a point with a diverged run has a hollow mark above all of them."""
    networks = list(NETWORKS)
    labels = {"weather": "still air"}
    team = [
        point({**labels, "network": networks[0]}, {"payload_rms_m": 0.02}),
        point({**labels, "network": networks[1]}, {"payload_rms_m": 0.03}, completed=2),
    ]
    alone = [point({**labels, "network": networks[0]}, {"payload_rms_m": 0.1})]
    figure = Figure()
    draw_weather(figure, {"precise": team, "alone": alone})
    (panel,) = figure.axes
    lines = [
        (np.ravel(line.get_xdata()).tolist(), np.ravel(line.get_ydata()).tolist())
        for line in panel.get_lines()
    ]
    assert ([-0.08, 0.92], [0.02, 0.03]) in lines
    assert ([0.08], [0.1]) in lines
    assert ([0.92], [0.93]) in lines  # of the height of the panel
    assert 0.1 / panel.get_ylim()[1] < 0.85
    assert ([0.0, 1.0], [0.1, 0.1]) in lines  # over the whole width


def test_a_class_named_as_a_scenario_has_its_file_in_the_arena() -> None:
    """Alone of alone.py is another algorithm than the scenario alone; other classes have their name alone."""
    figure = Figure()
    names = ("alone", "alone:Alone", "admm:ADMM")
    draw_arena(figure, [flown("perfect", name, RUNS, 0.1) for name in names])
    (panel,) = figure.axes
    shown = [label.get_text() for label in panel.get_xticklabels()]
    assert shown == ["alone", "alone:Alone", "ADMM"]


def test_what_was_not_flown_has_no_mark_and_no_tile() -> None:
    """A point that is refused has no runs: it is not one of which none completes."""
    unflown = replace(flown("late", "paper", 0, 0.0), runs=0)
    measured = [flown("perfect", "paper", RUNS, 0.01), unflown]
    figure = Figure()
    draw_arena(figure, measured)
    (panel,) = figure.axes
    edges = 3 + 1  # lines between the cells of one row and one column
    assert len(panel.get_lines()) == edges + 1  # the mark of the other point
    figure = Figure()
    draw_measure(figure, measured, "payload_rms_m", "payload error, cm", 100.0)
    assert len([patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]) == 1


@pytest.mark.parametrize(
    ("cost", "completed", "diverged_s", "text"),
    [
        (0.00999, RUNS, (), "9.99"),
        (0.01, RUNS, (), "10.0"),
        (0.002, 1, (3.0,), "2.00\n1 of 4"),
        (None, 0, (), "-"),
    ],
)
def test_a_cell_of_a_map_tells_its_number_or_why_it_has_none(
    cost: float | None, completed: int, diverged_s: Sequence[float], text: str
) -> None:
    """Numbers from ten on have one decimal; runs that raised an error tell nothing."""
    figure = Figure()
    labels = {"delay_s": 0.0, "loss": 0.0}
    one = point(labels, {"cost_mean": cost}, completed=completed, diverged_s=diverged_s)
    draw_maps(figure, DELAY, LOSS, COST, {"paper": [one]})
    assert [shown.get_text() for shown in figure.axes[0].texts] == [text, "paper"]


def test_a_cost_of_zero_has_the_lowest_colour_and_of_two_points_the_last_counts() -> None:
    """Zero has no logarithm; a point that is given twice has one number in its cell."""
    figure = Figure()
    labels = [{"delay_s": 0.0, "loss": loss} for loss in (0.0, 0.3, 0.3)]
    costs = (0.0, 0.01, 0.02)
    measured = [point(own, {"cost_mean": cost}) for own, cost in zip(labels, costs, strict=True)]
    draw_maps(figure, DELAY, LOSS, COST, {"paper": measured})
    texts = [(one.get_text(), one.get_color()) for one in figure.axes[0].texts]
    assert texts[:2] == [("0.00", "#ffffff"), ("20.0", "#000000")]
    coloured = figure.axes[0].get_images()[0].get_array()
    assert np.ma.filled(np.ma.asarray(coloured), 0.0).ravel() == pytest.approx([10.0, 20.0])


def test_a_variant_is_named_by_its_numbers_and_texts() -> None:
    """Numbers have their names; the variant without a value is named by its part alone."""
    figure = Figure()
    variants: list[Mapping[str, str | float]] = [
        {"part": "as it is", "value": ""},
        {"part": "received plans", "value": "by_age"},
        {"horizon": 20.0, "terminal": 5.0},
        {"horizon": 5.0, "terminal": "cost-to-go"},
    ]
    measured = [point({"network": "perfect", **labels}, ratio=0.5) for labels in variants]
    draw_variants(figure, {"paper": measured})
    (panel,) = figure.axes
    assert [label.get_text() for label in panel.get_yticklabels()] == [
        "as it is",
        "received plans: by age",
        "horizon 20, terminal weight 5",
        "horizon 5, cost-to-go",
    ]
    assert panel.get_xlim() == pytest.approx((0.5 / 1.15, 1.0 * 1.15))
    assert not [text for text in panel.texts if text.get_text() == "diverged"]


def test_tracking_without_a_completed_run_keeps_its_axes() -> None:
    """A point without numbers has no mark, and an axis without marks goes from 0 to 1."""
    figure = Figure()
    speed = Axis("speed_mps", "largest speed", "m/s")
    none = dict.fromkeys(("payload_rms_m", "payload_max_m", "attitude_max_deg"))
    draw_tracking(figure, [point({"case": "wind", "speed_mps": 3.0}, none)], speed, "case")
    for panel in figure.axes[0].child_axes:
        assert panel.get_xlim() == (0.0, 1.0)
        assert not panel.containers
