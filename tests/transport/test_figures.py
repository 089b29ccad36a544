"""Figures: every kind of run can be drawn, without side effects."""

import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree  # of files written here

import pytest

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message
from tests.support import runs
from tests.support.logs import SINGLE_UAV, log_of, plant_state, record_run
from transport.log.run_log import RunLog, read_log
from transport.report.figures import draw
from transport.report.report import write_report

NAMES = ["performance.png", "trajectories.png", "timing.png"]

# An empty figure with axes has a few thousand bytes.
SMALLEST_BYTES = 10_000
SMALLEST_PIXELS = 400


def assert_drawn(paths: Sequence[Path], names: Sequence[str] = NAMES) -> None:
    """Check that the files are PNG images with content, each with an SVG beside it."""
    assert [path.name for path in paths] == list(names)
    for path in paths:
        data = path.read_bytes()
        assert data.startswith(b"\x89PNG\r\n\x1a\n")
        assert len(data) > SMALLEST_BYTES
        assert min(struct.unpack(">II", data[16:24])) > SMALLEST_PIXELS
        assert ElementTree.parse(path.with_suffix(".svg")).getroot().tag.endswith("svg")  # noqa: S314  # our own


def logged(folder: Path, *settings: str) -> tuple[Setup, RunLog]:
    """Return a short run and its log."""
    run = runs.setup(runs.SHORT, *settings)
    record_run(run, folder)
    return run, read_log(folder / "run.mcap")


@pytest.mark.slow
def test_figures_are_drawn_with_the_report(tmp_path: Path) -> None:
    """The report of a run writes three figures to figures/, and drawing again replaces them."""
    run, log = logged(tmp_path)
    write_report(tmp_path)
    paths = [tmp_path / "figures" / name for name in NAMES]
    assert_drawn(paths)
    assert draw(run, log, tmp_path / "figures") == paths


@pytest.mark.slow
def test_one_uav_is_drawn(tmp_path: Path) -> None:
    """A team of one UAV has all figures."""
    run, log = logged(tmp_path, *SINGLE_UAV)
    assert_drawn(draw(run, log, tmp_path))


def test_a_diverged_run_is_drawn(tmp_path: Path) -> None:
    """A run that ended in its second phase is drawn up to its end."""
    run, log = logged(tmp_path, "plant.max_error_m=0.05")
    assert len(log.messages) > 1
    assert_drawn(draw(run, log, tmp_path))


def test_a_cut_log_is_drawn(tmp_path: Path) -> None:
    """A log cut in the middle is drawn up to the cut."""
    run, _ = logged(tmp_path)
    data = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: len(data) // 2])
    log = read_log(tmp_path / "run.mcap")
    assert log.cut
    assert_drawn(draw(run, log, tmp_path))


@pytest.mark.parametrize("ticks", [[0], [7], [0, 1, 9]])
def test_single_ticks_are_drawn(tmp_path: Path, ticks: list[int]) -> None:
    """One tick, one that is not the first, and ticks with gaps are drawn; without steps there is no timing figure."""
    run = runs.setup(runs.SHORT)
    messages: list[Message] = [plant_state(run, k) for k in ticks]
    assert_drawn(draw(run, log_of(messages), tmp_path), NAMES[:2])


def test_nothing_recorded_draws_nothing(tmp_path: Path) -> None:
    """A log without a plant state gives no figures and no folder."""
    assert draw(runs.setup(runs.SHORT), log_of([]), tmp_path / "figures") == []
    assert not (tmp_path / "figures").exists()


def test_drawing_has_no_side_effects(tmp_path: Path) -> None:
    """No setting of matplotlib is changed, and pyplot, which keeps its figures, is not used."""
    import matplotlib as mpl

    before, had_pyplot = dict(mpl.rcParams), "matplotlib.pyplot" in sys.modules
    run = runs.setup(runs.SHORT)
    draw(run, log_of([plant_state(run, 0), plant_state(run, 1)]), tmp_path)
    assert dict(mpl.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == had_pyplot
