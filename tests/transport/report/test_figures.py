"""Figures: every kind of run can be drawn, without side effects."""

import struct
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path
from xml.etree import ElementTree  # of files written here

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tests.support import runs
from tests.support.figure_texts import problems
from tests.support.log_messages import estimate_note, on_reference, radio_report, report
from tests.support.logs import log_of, record_run
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.series import Series
from transport.analysis.summary_assembly import summarise
from transport.interface.scenario_builder import Scenario
from transport.log.run_log import read_log
from transport.model import state
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import FaultNote, LinkChange
from transport.report.figures.captions import captions
from transport.report.figures.column import (
    head,
    label_ends,
    legend_height_in,
    limits,
    text_width_in,
)
from transport.report.figures.event_marks import caption_of, marks_of
from transport.report.figures.run_figures import FIGURES, draw, fill
from transport.report.figures.style import (
    COLUMN_IN,
    CURVES,
    RC,
    SMALL,
    label_decades,
    line_width,
    looks_of,
    save,
    scale_cost,
    shade_phases,
)
from transport.report.report import write_report
from transport.scene.uav_and_link_colours import uav_marker, uav_style

NAMES = ["performance.png", "inputs.png", "trajectories.png", "timing.png"]

# An empty figure with axes has a few thousand bytes.
SMALLEST_BYTES = 10_000
SMALLEST_PIXELS = 400
LARGE_TEAM = 8
ROUNDING = 1e-15  # of a team at rest
# Least range of an axis, m, deg, N, and least end of one of costs: far above rounding errors.
LEAST_RANGE, LEAST_DECADE = 1e-7, 1e-12


def assert_drawn(paths: Sequence[Path], names: Sequence[str] = NAMES) -> None:
    """Check that the files are PNG images with content."""
    assert [path.name for path in paths] == list(names)
    for path in paths:
        data = path.read_bytes()
        assert data.startswith(b"\x89PNG\r\n\x1a\n")
        assert len(data) > SMALLEST_BYTES
        assert min(struct.unpack(">II", data[16:24])) > SMALLEST_PIXELS


@pytest.mark.parametrize(
    ("settings", "share"),
    [
        pytest.param(runs.SINGLE_UAV, 1.0, marks=pytest.mark.slow),
        (["plant.max_error_m=0.05"], 1.0),  # diverged in its second phase
        ([], 0.5),
    ],
    ids=["one-uav", "diverged", "cut"],
)
def test_runs_are_drawn(tmp_path: Path, settings: Sequence[str], share: float) -> None:
    """A single UAV, a run that diverged, and a cut log are drawn as far as the log goes.

    Drawing again replaces.
    """
    record_run(runs.setup(runs.SHORT, *settings), tmp_path)
    log = tmp_path / "run.mcap"
    data = log.read_bytes()
    log.write_bytes(data[: round(share * len(data))])
    assert bool(read_log(log).cut) == (share < 1.0)
    write_report(tmp_path)
    paths = [tmp_path / "figures" / name for name in NAMES]
    assert_drawn(paths)
    assert sorted((tmp_path / "figures").iterdir()) == sorted(paths)  # SVG and PDF on request only


@pytest.mark.slow
def test_vectors_are_written_on_request(tmp_path: Path) -> None:
    """On request each figure is an SVG and a PDF too, equal for equal runs."""
    run = runs.setup(runs.SHORT)
    log = log_of([on_reference(run, 0), on_reference(run, 1)])
    paths = draw(AnalysedRun.of(run, log), tmp_path / "a", also=["svg", "pdf"])
    draw(AnalysedRun.of(run, log), tmp_path / "b", also=["svg", "pdf"])
    for path in paths:
        again = tmp_path / "b" / path.name
        data = path.with_suffix(".pdf").read_bytes()
        assert data.startswith(b"%PDF")
        assert data == again.with_suffix(".pdf").read_bytes()

        drawing = path.with_suffix(".svg")
        assert ElementTree.parse(drawing).getroot().tag.endswith("svg")  # noqa: S314  # our own
        assert drawing.read_bytes() == again.with_suffix(".svg").read_bytes()


@pytest.mark.parametrize("name", FIGURES)
def test_texts_are_large_and_apart(name: str) -> None:
    """No text collides with another, leaves the figure or is too small, with marks near each other and short phases."""
    changes = "links.change=[{at_s=0.5,delay_s=0.2,loss=0.3},{at_s=0.52,loss=0.1}]"
    run = runs.setup(
        *(runs.SHORT, changes, "radio={}"),
        "links.partition=[{between=['agent2'],start_s=0.2,end_s=0.9}]",
    )
    log = log_of(
        [
            *(on_reference(run, k) for k in range(20)),
            *(radio_report(run, k) for k in range(1, 20)),
            *(report(run, a, k) for a in (1, 2) for k in range(20)),
            estimate_note(run, 1, 9),
        ]
    )
    figure = Figure()
    with mpl.rc_context(RC):
        assert fill(figure, name, AnalysedRun.of(run, log))
        assert problems(figure, SMALL) == []
    assert figure.get_figwidth() == COLUMN_IN


def test_events_are_marked() -> None:
    """Faults and link changes, by script and by hand, are marks in the order of time, each once, with a caption."""
    changes = "links.change=[{at_s=0.5,delay_s=0.2,loss=0.3}]"
    partition = "links.partition=[{between=['agent2'],start_s=0.2,end_s=9.0}]"
    run = runs.setup(runs.SHORT, changes, partition)
    given = '{"loss": 1.0}'
    by_hand = LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=8,
        number=1,
        source="agent1",
        target="",
        settings=given,
    )
    note = FaultNote(
        sender="recorder",
        incarnation=0,
        sequence=0,
        tick=20,
        target="agent3",
        what="killed",
        origin="person",
    )
    marks = marks_of(run, log_of([by_hand, by_hand, note]))
    assert [(mark.time_s, mark.of_links) for mark in marks] == [
        (0.2, True),
        (0.4, True),
        (0.5, True),
        (1.0, False),
    ]
    caption = " ".join(caption_of(marks))
    assert "1: agent2 cut off (0.2 s); 2: links from agent1: loss 1.0 (0.4 s)" in caption
    assert (
        "3: links between agents: delay_s 0.2, loss 0.3 (0.5 s); 4: agent3 killed (1 s)" in caption
    )


def test_drawing_has_no_side_effects(tmp_path: Path) -> None:
    """No setting of matplotlib is changed, and pyplot, which keeps its figures, is not used."""
    before, had_pyplot = dict(mpl.rcParams), "matplotlib.pyplot" in sys.modules
    run = runs.setup(runs.SHORT)
    draw(AnalysedRun.of(run, log_of([on_reference(run, 0), on_reference(run, 1)])), tmp_path)
    assert dict(mpl.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == had_pyplot


@pytest.mark.parametrize("name", ["performance", "inputs"])
def test_figures_of_large_teams_have_legends(name: str) -> None:
    """A figure of more than five UAVs has a legend of all, above its panels and apart from them."""
    scenario = Scenario("resilient").resized(LARGE_TEAM)
    run = Setup.of(scenario.validated, "large")
    reports = [report(run, agent, k) for agent in run.agents for k in range(3)]
    log = log_of([*(on_reference(run, k) for k in range(3)), *reports])
    figure = Figure()
    with mpl.rc_context(RC):
        assert fill(figure, name, AnalysedRun.of(run, log))
        assert problems(figure, SMALL) == []
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == [f"UAV{i}" for i in range(1, LARGE_TEAM + 1)]


@pytest.mark.parametrize("name", ["performance", "inputs"])
def test_no_axis_shows_rounding_errors(name: str) -> None:
    """Axes of a team at rest have ranges that matter, although its costs and errors are 1e-15."""
    run = runs.setup(runs.SHORT)
    log = log_of([on_reference(run, k) for k in range(9)])
    figure = Figure()
    with mpl.rc_context(RC):
        analysed = AnalysedRun.of(run, log)
        assert fill(figure, name, replace(analysed, series=at_rest(analysed.series)))
    for panel in figure.axes:
        low, high = panel.get_ylim()
        assert high - low > LEAST_RANGE
        assert panel.get_yscale() == "linear" or low > LEAST_DECADE


def test_a_sentence_stands_for_flat_curves() -> None:
    """A panel whose curves do not change is one sentence, apart from others and within the figure.

    The first panel stays also for a team at rest.
    """
    run = runs.setup(runs.SHORT)
    analysed = AnalysedRun.of(run, log_of([on_reference(run, k) for k in range(9)]))
    moving = replace(analysed.series, u=np.array(analysed.series.u))
    moving.u[:, 1] += 0.1 * np.arange(9)  # roll of the first UAV
    moving.u[:, 0] += np.arange(9)
    # Each of four UAVs has a strip of its own.
    for series, panels in ((moving, 8), (at_rest(analysed.series), 4)):
        figure = Figure()
        with mpl.rc_context(RC):
            assert fill(figure, "inputs", replace(analysed, series=series))
            assert problems(figure, SMALL) == []
        assert sum(panel.axison for panel in figure.axes) == panels
        texts = [text.get_text() for panel in figure.axes for text in panel.texts]
        (last,) = (panel for panel in figure.axes if panel.get_xlabel() == "time (s)")
        assert last.axison  # sentences stand above it
        assert last.get_position().y0 == min(panel.get_position().y0 for panel in figure.axes)
        assert "pitch moment: 0 N m throughout" in texts
        assert "smallest distance between UAVs: 0.5 m throughout" in texts


def test_panels_of_inputs_name_their_limits() -> None:
    """Different ends are both told, equal ones once; each agent has the age of its oldest plan, s."""
    run = runs.setup(runs.SHORT)
    ages = [report(run, agent, k, plan_ages=(1, 2, agent)) for agent in (1, 4) for k in range(9)]
    unheard = report(run, 2, 0)
    analysed = AnalysedRun.of(
        run, log_of([*(on_reference(run, k) for k in range(9)), *ages, unheard])
    )
    figure = Figure()
    with mpl.rc_context(RC):
        assert fill(figure, "inputs", analysed)
    texts = [text.get_text() for panel in figure.axes for text in panel.texts]
    assert "thrust (N), limits 0, 45" in texts
    assert "roll moment: 0 N m throughout" in texts
    plans = figure.axes[[panel.get_xlabel() for panel in figure.axes].index("time (s)")]
    curves = {str(line.get_label()): np.unique(line.get_ydata()) for line in plans.lines}
    assert curves["agent 1"] == pytest.approx([0.1])
    assert curves["4"] == pytest.approx([0.2])
    assert [line.get_color() for line in plans.lines if line.get_label() == "4"] == [
        uav_style(3)["color"]
    ]
    assert "2" not in curves


@pytest.mark.parametrize(
    ("name", "settings", "told", "untold"),
    [
        ("paper", (runs.SHORT,), "oldest plan used: 0.05 s throughout", "rate"),
        ("eight", (), "pitch rate command: 0 rad/s throughout", "moment"),
        ("paper", (runs.SHORT, *runs.SINGLE_UAV), "pitch moment: 0 N m throughout", "distance"),
    ],
)
def test_inputs_are_those_that_the_team_has(
    name: str, settings: Sequence[str], told: str, untold: str
) -> None:
    """Body rates in rad/s in place of moments; a single UAV has no distance; an age that is kept is told."""
    run = runs.ready(name, *settings)
    reports = [report(run, agent, k) for agent in run.agents for k in range(3)]
    figure = Figure()
    with mpl.rc_context(RC):
        log = log_of([*(on_reference(run, k) for k in range(3)), *reports])
        assert fill(figure, "inputs", AnalysedRun.of(run, log))
    texts = [text.get_text() for panel in figure.axes for text in panel.texts]
    assert told in texts
    assert not any(untold in text for text in texts)


def test_the_distance_of_uavs_is_shown_with_its_limit() -> None:
    """From the limit on, at which a line is drawn."""
    run = runs.setup(runs.SHORT)
    analysed = AnalysedRun.of(run, log_of([on_reference(run, k) for k in range(3)]))
    figure = Figure()
    with mpl.rc_context(RC):
        series = replace(analysed.series, separation_m=np.array([0.5, 0.6, 0.7]))
        assert fill(figure, "inputs", replace(analysed, series=series))
    (panel,) = (
        panel
        for panel in figure.axes
        for text in panel.texts
        if text.get_text() == "smallest distance between UAVs (m), limit 0.4"
    )
    assert 0.3 < panel.get_ylim()[0] < 0.4
    assert [0.4, 0.4] in [np.ravel(line.get_ydata()).tolist() for line in panel.lines]


def test_the_panel_of_obstacles_shows_what_is_near_or_within_one() -> None:
    """From the deepest distance to six times the margin, 0.3 m, at which a line is drawn."""
    obstacle = "obstacle=[{kind='sphere',at_m=[9.0,0.0,-10.0],radius_m=0.5,margin_m=0.3,load_margin_m=0.2}]"
    run = runs.setup(runs.SHORT, obstacle)
    analysed = AnalysedRun.of(run, log_of([on_reference(run, k) for k in range(3)]))
    clearance_m = np.array([[9.0, 8.0, 7.0], [0.5, 0.4, -0.2], [0.4, 0.3, 0.1]])
    figure = Figure()
    with mpl.rc_context(RC):
        series = replace(analysed.series, clearance_m=clearance_m)
        assert fill(figure, "inputs", replace(analysed, series=series))
    (panel,) = (
        panel
        for panel in figure.axes
        for text in panel.texts
        if text.get_text() == "distance from obstacles (m)"
    )
    assert panel.get_ylim() == pytest.approx((-0.2, 1.8))
    levels = [np.ravel(line.get_ydata()).tolist() for line in panel.lines]
    assert [level for level in levels if len(level) == 2] == [[0.2, 0.2], [0.3, 0.3]]


@pytest.mark.parametrize(
    ("top", "ends"), [(2.0, (0.002, 4.0)), (1e-9, (1e-9, 2e-6)), (0.0, None), (np.inf, None)]
)
def test_a_cost_has_decades_below_its_highest(top: float, ends: tuple[float, float] | None) -> None:
    """Three of them; costs below 1e-6 are rounding errors, and a run without cost keeps its axis."""
    axes = Figure().add_subplot()
    scale_cost(axes, top, 3)
    assert axes.get_yscale() == ("linear" if ends is None else "log")
    assert axes.get_ylim() == pytest.approx(ends or (0.0, 1.0))


@pytest.mark.parametrize(
    ("limit", "shown"),
    [(0.5, (0.0, 1.0)), (1.4, (0.0, 1.45)), (1.6, None), (-0.4, (-0.45, 1.0)), (-0.6, None)],
)
def test_a_limit_near_the_curves_is_drawn(limit: float, shown: tuple[float, float] | None) -> None:
    """Within half of the range that the axis shows, which then has room for it."""
    panel = Figure().add_subplot()
    panel.set_ylim(0.0, 1.0)
    limits(panel, limit)
    assert [line.get_ydata() for line in panel.lines] == ([] if shown is None else [[limit, limit]])
    assert panel.get_ylim() == pytest.approx(shown or (0.0, 1.0))


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(0.0, 1.0, [0.0, 0.5]), (-0.3, 0.3, [-0.3, 0.1]), (19.0, 23.0, [20.0, 22.0])],
)
def test_a_low_panel_has_two_round_numbers(low: float, high: float, ticks: list[float]) -> None:
    """At least 0.4 of the range apart, and 0.2 of it below the panel above."""
    panel = Figure().add_subplot()
    panel.set_ylim(low, high)
    label_ends(panel)
    assert panel.get_yticks() == pytest.approx(ticks)


def test_each_of_few_uavs_has_a_strip() -> None:
    """Equal curves of four UAVs do not hide each other: each has its own axes, of one range, with its name."""
    run = runs.setup(runs.SHORT)
    figure = Figure()
    with mpl.rc_context(RC):
        assert fill(
            figure,
            "performance",
            AnalysedRun.of(run, log_of([on_reference(run, k) for k in range(9)])),
        )
    by_name = {
        text.get_text(): panel
        for panel in figure.axes
        for text in panel.texts
        if text.get_text().removeprefix("UAV").isdigit()
    }
    strips = list(by_name.values())
    assert list(by_name) == ["UAV1", "UAV2", "UAV3", "UAV4"]
    assert [len(strip.lines) for strip in strips] == [1] * 4
    assert len({strip.get_ylim() for strip in strips}) == 1
    assert len({strip.get_position().bounds for strip in strips}) == 4


def test_captions_have_the_numbers_of_the_summary() -> None:
    """Every figure has a caption, and that of the performance the numbers of the run; also without any."""
    run = runs.setup(runs.SHORT)
    analysed = AnalysedRun.of(run, log_of([on_reference(run, k) for k in range(9)]))
    summary = summarise(analysed)
    made = captions(run, summary, FIGURES)
    assert list(made) == list(FIGURES)
    assert f"at most {100.0 * summary['uav_tracking']['max_m']:.1f} cm" in made["performance"]
    assert f"at least {summary['separation_min_m']:.3f} m" in made["inputs"]
    assert all(f"seed {run.scenario.seed}" in caption for caption in made.values())

    nothing = {**summary, "separation_min_m": None, "agent_step_ms": None, "radio": None}
    assert "at least unknown" in captions(run, nothing, FIGURES)["inputs"]


def test_ten_curves_are_told_apart() -> None:
    """Ten curves differ in marker, and in colour or line; ten UAVs in colour or line and marker."""
    assert len(CURVES) == 10
    assert len({marker for _, marker, _ in CURVES}) == 10
    assert len({(colour, line) for colour, _, line in CURVES}) == 10
    assert len({tuple(uav_style(i).values()) for i in range(10)}) == 10
    assert len({(uav_style(i)["color"], uav_marker(i)) for i in range(10)}) == 10


def test_curves_that_coincide_stay_visible() -> None:
    """The first of three curves is the widest, the last 1 point wide, as is one alone."""
    assert [line_width(i, 3, 2.0) for i in range(3)] == [2.0, 1.5, 1.0]
    assert line_width(0, 1, 2.0) == 1.0


def test_every_other_phase_is_shaded() -> None:
    """Of phases of 1, 2 and 1, 1 s, cut at 4.5 s, the second and fourth are shaded, and panels end there."""
    lasting = ",".join(
        f"{{name='p',duration_s={duration_s},displacement_m=[0,0,0]}}"
        for duration_s in (1.0, 2.0, 1.0, 1.0, 1.0)
    )
    figure, axes = plt.subplots(2)
    try:
        shade_phases(runs.setup(f"maneuver.phase=[{lasting}]"), list(axes), 4.5)
        for panel in axes:
            spans = [
                patch.get_extents().transformed(panel.transData.inverted())
                for patch in panel.patches
            ]
            assert [(round(span.x0, 9), round(span.x1, 9)) for span in spans] == [
                (1.0, 3.0),
                (4.0, 4.5),
            ]
            assert panel.get_xlim() == (0.0, 4.5)
    finally:
        plt.close(figure)


def test_phases_with_room_have_their_names_above_the_first_panel() -> None:
    """In the middle of what is shown of them; a name that has one letter too many would touch the next one."""
    panels = list(Figure(dpi=100.0).subplots(2))
    width_pt = 72.0 * panels[0].get_window_extent().width / 100.0
    letters = int(width_pt / 4.0 / (0.62 * SMALL))  # that fit one of four seconds
    phases = ",".join(
        f"{{name='{name}',duration_s=1.0,displacement_m=[0,0,0]}}"
        for name in ("a" * letters, "b" * (letters + 1), "c", "d" * letters, "e")
    )
    run = runs.setup(f"maneuver.phase=[{phases}]")
    shade_phases(run, panels, 4.0)
    told = [(text.get_text(), text.get_position()[0]) for text in panels[0].texts]
    assert told == [("a" * letters, 0.5), ("c", 2.5), ("d" * letters, 3.5)]
    assert not panels[1].texts

    others = list(Figure(dpi=100.0).subplots(2))
    shade_phases(run, others, 4.0, named=False)
    assert not others[0].texts


def test_files_of_figures_name_neither_program_nor_date(tmp_path: Path) -> None:
    """Equal figures give equal files."""
    with mpl.rc_context(RC):
        files = save(Figure(), tmp_path / "a.png")
    assert [file.suffix for file in files] == [".png", ".svg"]
    for file in files:
        content = file.read_bytes()
        for name in (b"Software", b"dc:date", b"dc:creator"):
            assert name not in content, (file.name, name)


@pytest.mark.parametrize(
    ("names", "colours", "shapes"),
    [
        ([f"m{i}, x" for i in range(2)], 2, 2),  # few names: each has its own colour
        ([f"m{i}, x" for i in range(6)], 5, 6),  # more first parts than colours
        ([f"{a}, {b}, {c}" for a in "pq" for b in "rs" for c in "tu"], 2, 4),
    ],
)
def test_names_of_parts_share_colours_only_where_they_are_many(
    names: Sequence[str], colours: int, shapes: int
) -> None:
    """The part before the first comma has the colour, the rest together the marker."""
    looks = looks_of(names)
    assert len(set(looks.values())) == len(names)
    assert len({look.colour for look in looks.values()}) == colours
    assert len({look.marker for look in looks.values()}) == shapes


@pytest.mark.parametrize(("count", "beside"), [(1, False), (2, True), (5, True), (6, False)])
def test_a_legend_beside_a_title_has_two_to_five_curves(count: int, *, beside: bool) -> None:
    """A single curve is named by the title, more than five by the legend above all panels."""
    panel = Figure().add_subplot()
    for number in range(count):
        panel.plot([0.0], [0.0], label=f"{number}")
    head(panel, "title")
    assert (panel.get_legend() is not None) is beside


def test_a_legend_has_the_height_of_its_rows() -> None:
    """0.115 in each and a rim of 0.06 in; a formula is as wide as it is drawn."""
    handles = [Line2D([], [], label="UAV1") for _ in range(30)]
    heights_in = [legend_height_in(handles[:count]) for count in (0, 1, 2)]
    assert heights_in == pytest.approx([0.0, 0.175, 0.175])
    assert legend_height_in(handles) > 0.4
    assert text_width_in("$x$") < 1.5 * text_width_in("x")


def test_nine_names_beside_known_ones_differ() -> None:
    """Nine other names and a known one have ten styles."""
    names = ["paper", *(f"m{i}" for i in range(9))]
    assert len(set(looks_of(names).values())) == 10


def test_controllers_and_networks_have_their_own_style() -> None:
    """A name has the same style in every figure, and no other name of a figure its colour and marker."""
    together = looks_of(
        ["alone", "mine", "precise", "paper", "resilient", "centralized_lq", "yours"]
    )
    assert looks_of(["mine", "paper"])["paper"] == together["paper"]
    assert looks_of(["late", "perfect"])["perfect"] == looks_of(["perfect"])["perfect"]
    assert len({style[:2] for style in together.values()}) == len(together)

    pairs = [f"{rate} Mb/s, {way}" for rate in (6, 24) for way in ("slots", "none", "on change")]
    styles = looks_of(pairs)
    assert len(set(styles.values())) == len(pairs)
    assert {style[0] for name, style in styles.items() if name.startswith("6 ")} == {
        styles[pairs[0]][0]
    }
    assert styles["6 Mb/s, slots"][1:] == styles["24 Mb/s, slots"][1:]


def at_rest(series: Series) -> Series:
    """Return a series with rounding errors in place of every cost, error and change."""
    tiny = ROUNDING * np.arange(1.0, len(series.ticks) + 1.0)
    return replace(
        series,
        cost=tiny**2,
        payload_reference_I=series.x[:, state.R0] + tiny[:, None],
        uav_references_I=series.uavs_I + tiny[:, None, None],
        attitude_deg=np.tile(tiny[:, None], 3),
        u=series.u[0] + tiny[:, None],
        separation_m=series.separation_m[0] + tiny,
    )


def changes_of(ends: Sequence[tuple[str, str]]) -> list[LinkChange]:
    """Return the changes by one request, which loses all messages of some links from tick 4 on."""
    return [
        LinkChange(
            sender="coordinator",
            incarnation=0,
            sequence=number,
            tick=4,
            number=number,
            source=source,
            target=target,
            settings='{"loss": 1.0}',
        )
        for number, (source, target) in enumerate(ends, start=1)
    ]


def killed(tick: int) -> FaultNote:
    """Return the note that an agent was killed."""
    return FaultNote(
        sender="recorder",
        incarnation=0,
        sequence=0,
        tick=tick,
        target="agent3",
        what="killed",
        origin="person",
    )


def test_what_a_run_did_not_reach_is_not_marked() -> None:
    """Scripted changes and partitions after the last tick of the log have no mark."""
    run = runs.setup(
        runs.SHORT,
        "links.change=[{at_s=0.45,loss=0.1},{at_s=0.46,loss=0.2}]",
        "links.partition=[{between=['agent2'],start_s=0.2,end_s=0.9},"
        "{between=['agent3'],start_s=0.7,end_s=0.9}]",
    )
    ended_early = marks_of(run, log_of([on_reference(run, k) for k in range(10)]))  # until 0.45 s
    assert [mark.time_s for mark in ended_early] == [0.2, 0.45]
    completed = marks_of(run, log_of([on_reference(run, k) for k in range(run.ticks)]))
    assert [mark.time_s for mark in completed] == [0.2, 0.45, 0.46, 0.7, 0.9, 0.9]
    assert marks_of(run, log_of([])) == []


def test_a_request_is_one_mark() -> None:
    """A cut between groups is one mark, as is a change of all links; later faults have their own."""
    run = runs.setup(runs.SHORT)
    groups = ("agent1", "agent2"), ("agent3", "agent4")
    pairs = [pair for one, other in permutations(groups) for pair in product(one, other)]
    marks = marks_of(run, log_of([*changes_of(pairs), killed(20)]))
    assert [(mark.text, mark.of_links) for mark in marks] == [
        ("8 links: loss 1.0", True),
        ("agent3 killed", False),
    ]
    (mark,) = marks_of(run, log_of(changes_of([("", ""), ("plant", ""), ("", "plant")])))
    assert (mark.text, mark.of_links) == ("all links: loss 1.0", True)


def test_the_caption_counts_what_is_not_marked() -> None:
    """Of many events the first have marks, and the caption says how many others there are."""
    run = runs.setup(runs.SHORT)
    states = [on_reference(run, k) for k in range(run.ticks)]
    notes = [killed(tick) for tick in range(15)]
    figure = Figure()
    with mpl.rc_context(RC):
        assert fill(figure, "inputs", AnalysedRun.of(run, log_of([*states, *notes])))
        assert problems(figure, SMALL) == []
    (caption,) = (text.get_text() for text in figure.texts if "killed" in text.get_text())
    numbered = caption.count("killed")
    assert numbered < len(notes)
    assert caption.endswith(f"{len(notes) - numbered} more not marked")
    few = marks_of(run, log_of([*states, *notes[:3]]))
    assert "not marked" not in " ".join(caption_of(few))


@pytest.mark.parametrize(
    ("low", "high", "shown"),
    [
        (0.68, 3.0, [0.7, 1.0, 1.5, 2.0, 3.0]),
        (0.76, 1.56, [0.8, 0.9, 1.0, 1.2, 1.5]),
        (0.1, 12.0, [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]),
    ],
)
def test_a_logarithmic_axis_has_enough_numbers(low: float, high: float, shown: list[float]) -> None:
    """Four or more, however few decades it has."""
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(low, high))
    label_decades(axes.xaxis)
    assert [tick for tick in axes.get_xticks() if low <= tick <= high] == pytest.approx(shown)
