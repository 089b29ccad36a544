"""Animation of a run: number of frames, motion, size, and equal files of equal runs."""

import shutil
import struct
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from tests.support import runs
from tests.support.logs import record_run
from transport.analysis.series import series_of
from transport.cli.main import app
from transport.log.run_folder import open_run
from transport.model.state import R0
from transport.report.animation import FPS, LENGTH_S, AnimationPage, animate_run
from transport.scene.lines_meshes_and_labels import Part
from transport.scene.scene_at_tick import Scene, SceneBuilder

# Largest size of a frame with moving lines.
LARGEST_FRAME_BYTES = 40_000
MOVED = 0.001  # share of pixels that differ at the end
SPEED = 8.0  # two frames


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short run."""
    folder = tmp_path_factory.mktemp("moving")
    record_run(runs.setup(runs.SHORT), folder)
    return folder


def test_a_gif_moves(recorded: Path) -> None:
    """The number of frames follows from duration and speed, the last differs from the first, frames are small."""
    path = animate_run(recorded, recorded / "a.gif", speed=SPEED)
    with Image.open(path) as image:
        count = int(getattr(image, "n_frames", 0))
        first = np.asarray(image.convert("RGB"))
        image.seek(count - 1)
        last = np.asarray(image.convert("RGB"))
    duration_s = 29 * 0.05
    assert count == pytest.approx(duration_s / SPEED * FPS, abs=1.0)
    assert (first != last).any(axis=2).mean() > MOVED
    assert path.stat().st_size < LARGEST_FRAME_BYTES * count
    assert animate_run(recorded, recorded / "b.gif", speed=SPEED).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("released", [(), (2,), (1, 2, 3, 4)])
def test_the_view_from_above_follows_payload_and_uavs_on_their_rods(
    recorded: Path, released: tuple[int, ...]
) -> None:
    """Its centre is between payload and mean of the UAVs on their rods, all of which it shows.

    One that flies away after its release does not move or widen it.
    """
    run = open_run(recorded)
    builder = SceneBuilder.of(run.setup, run.log)
    uavs_I = np.array([[3.0, 0.0, 0.0], [90.0, 70.0, 0.0], [4.0, 3.0, 0.0], [2.0, 0.0, 0.0]])
    scene = replace(
        builder.at(0), payload_I=np.array([1.0, 5.0, -8.0]), uavs_I=uavs_I, released=released
    )
    flown = series_of(run.setup, run.log)
    x = flown.x.copy()
    x[:, R0] = scene.payload_I
    on_rods = np.ones_like(flown.on_rods)
    on_rods[:, [uav - 1 for uav in released]] = False
    throughout = np.tile(uavs_I, (len(x), 1, 1))
    page = AnimationPage(builder, replace(flown, x=x, uavs_I=throughout, on_rods=on_rods))
    page.show(scene)
    centre = [float(np.mean(page.above.get_xlim())), float(np.mean(page.above.get_ylim()))]
    by_hand = {(): [12.875, 11.625], (2,): [2.0, 3.0], (1, 2, 3, 4): [1.0, 5.0]}
    assert centre == pytest.approx(by_hand[released])

    # Half a meter beyond the farthest of them, at right angles to a width of 1.9 heights.
    half_height_m = {(): 70.0 - 11.625, (2,): 3.0, (1, 2, 3, 4): 0.0}[released] + 0.5
    bottom, top = page.above.get_ylim()
    left, right = page.above.get_xlim()
    assert (bottom - top, right - left) == pytest.approx((2.0 * half_height_m, 3.8 * half_height_m))


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg")
def test_an_mp4_is_written(recorded: Path) -> None:
    """The file begins with the header of an MP4, and no setting of matplotlib is left changed."""
    before = dict(mpl.rcParams)
    size, kind = struct.unpack(
        ">I4s", animate_run(recorded, recorded / "a.mp4", speed=SPEED).read_bytes()[:8]
    )
    assert kind == b"ftyp"
    assert size < 100
    assert dict(mpl.rcParams) == before


def test_unsupported_files_are_refused(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other kinds of files, and MP4 without ffmpeg, are refused in one line before anything is written."""
    monkeypatch.setenv("PATH", str(tmp_path))
    for name, why in (("a.avi", "ends in .gif or .mp4"), ("a.mp4", "needs ffmpeg")):
        result = CliRunner().invoke(app, ["plot", str(recorded), "--animate", str(tmp_path / name)])
        assert result.exit_code == 2
        assert result.stderr.startswith("transport: --animate: ")
        assert why in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert not (recorded / "summary.json").exists()


@pytest.mark.parametrize(
    ("speed", "length_s", "apart"),
    [(None, 6.0, 2), (1.0, 0.5, 2), (4.0, 6.0, 8), (None, 0.75, 4), (0.25, 6.0, 0.5)],
)
def test_frames_are_a_tenth_of_a_second_of_the_animation_apart(
    recorded: Path,
    speed: float | None,
    length_s: float,
    apart: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A run of 1.5 s, or at most the length of the animation, has its own speed; the first frame is the first tick."""
    assert LENGTH_S == 6.0
    monkeypatch.setattr("transport.report.animation.LENGTH_S", length_s)
    ticks: list[int] = []

    class Still(AnimationPage):
        def show(self, scene: Scene) -> None:
            ticks.append(scene.tick)

    class Unwritten:
        def saving(self, *_: object) -> AbstractContextManager[None]:
            return nullcontext()

        def grab_frame(self) -> None:
            """Write nothing."""

    monkeypatch.setattr("transport.report.animation.AnimationPage", Still)
    monkeypatch.setattr("transport.report.animation._writer", lambda _: Unwritten())
    animate_run(recorded, recorded / "none.gif", speed=speed)
    # Slower than ten ticks a second, frames repeat.
    assert ticks == [min(29, round(tick)) for tick in np.arange(0.0, 30.0, apart)]


def test_each_view_has_its_parts(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Links from above alone, thrust and flown paths in space alone; the reference is part of the page in space."""
    layers: dict[bool, set[str]] = {}

    def keep(
        _: object, parts: Iterable[Part], *_rest: object, above: bool, **__: object
    ) -> list[Any]:
        layers[above] = {part.layer for part in parts}
        return []

    monkeypatch.setattr("transport.report.animation.draw_parts", keep)
    run = open_run(recorded)
    builder = SceneBuilder.of(run.setup, run.log)
    page = AnimationPage(builder, series_of(run.setup, run.log))
    page.show(builder.at(9))
    space: Any = page.figure.axes[0]
    low, high = space.get_zlim()
    assert low < -builder.at(9).payload_I[2] < -builder.at(9).uavs_I[0, 2] < high
    assert layers[True] - layers[False] == {"links"}
    assert layers[False] - layers[True] == {"actual paths", "thrust"}
    assert "reference" not in layers[True] | layers[False]


def test_a_run_of_one_tick_has_a_page(recorded: Path) -> None:
    """Its axes over time have a length, too."""
    run = open_run(recorded)
    first = tuple(entry for entry in run.log.messages if entry.message.tick == 0)
    log = replace(run.log, messages=first)
    builder = SceneBuilder.of(run.setup, log)
    page = AnimationPage(builder, series_of(run.setup, log))
    page.show(builder.at(0))
    low, high = page.figure.axes[-1].get_xlim()
    assert low < high


def test_a_frame_replaces_the_one_before(recorded: Path) -> None:
    """Time and phase of the scene are told, a line marks the time in both curves, and nothing of before is left."""
    run = open_run(recorded)
    builder = SceneBuilder.of(run.setup, run.log)
    flown = series_of(run.setup, run.log)
    cost = flown.cost.copy()
    cost[3] = 0.0
    page = AnimationPage(builder, replace(flown, cost=cost))
    counts = set()
    for tick in (4, 20):
        page.show(builder.at(tick))
        *_, over, under = page.figure.axes
        counts.add(tuple(len(axes.get_children()) for axes in page.figure.axes))
        marks = [np.ravel(axes.lines[-1].get_xdata()).tolist() for axes in (over, under)]
        assert marks == [[pytest.approx(0.05 * tick)] * 2] * 2
    assert len(counts) == 1
    assert page.figure.texts[-1].get_text() == " 1.00 s   climb"
    assert len(page.figure.texts) == 2
    curve, angle = (np.asarray(axes.lines[0].get_ydata()) for axes in (over, under))
    assert np.flatnonzero(np.isnan(curve)).tolist() == [3]
    assert angle == pytest.approx(np.abs(flown.attitude_deg).max(axis=1))
