"""The benchmark of silent networks: its measure of errors, and kept runs."""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import silence
from benchmarks.silence import Case, Flown, Kept
from docs.tables import table
from transport.model.arrays import Array

PERIOD_S = 0.05
CASE = Case(name="a case", scenario="precise", silent_s=3.0)


def _flown(error_m: Array) -> Flown:
    ticks = len(error_m)
    return Flown(
        outcome="completed",
        reason="",
        error_m=error_m,
        attitude_deg=np.arange(ticks, dtype=np.float64),
        separation_m=np.full(ticks, 0.5),
        resets=0,
        period_s=PERIOD_S,
    )


def test_errors_of_all_seeds_count_together(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A silence that doubles the error of one seed, and leaves that of another, does not double it."""
    ticks = 500

    def fly(_: str, settings: tuple[str, ...]) -> Flown:
        is_first = "seed=0" in settings
        is_silent = any("partition" in setting for setting in settings)
        level_m = 0.01 if is_first else 0.1
        return _flown(np.full(ticks, level_m * (2.0 if is_first and is_silent else 1.0)))

    monkeypatch.setattr(silence, "fly", fly)
    result = silence.run(CASE, range(2), Kept(tmp_path))
    flown_m, alone_m, undisturbed_m = result.during.rms()
    assert flown_m == pytest.approx(math.sqrt((0.02**2 + 0.1**2) / 2.0))
    assert alone_m == undisturbed_m == pytest.approx(math.sqrt((0.01**2 + 0.1**2) / 2.0))
    assert result.runs == result.completed == 2


def test_kept_runs_are_read_and_not_flown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A second benchmark reads the numbers of the first, bit for bit, and flies nothing."""
    flown = _flown(np.random.default_rng(0).random(20))
    monkeypatch.setattr(silence, "fly", lambda *_: flown)
    kept = Kept(tmp_path)
    assert kept.fly("precise", ("seed=0",)) is not None

    monkeypatch.delattr(silence, "fly")
    again = kept.fly("precise", ("seed=0",))
    assert again is not None
    np.testing.assert_array_equal(again.error_m, flown.error_m)
    assert (again.outcome, again.resets, again.period_s) == ("completed", 0, PERIOD_S)
    assert Kept(tmp_path, is_flying=False).fly("precise", ("seed=1",)) is None


def test_only_whole_rows_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    """Kept runs alone may be a part of a row: they are not written."""
    with pytest.raises(SystemExit) as caught:
        silence.main(["--no-fly", "--write"])
    assert caught.value.code == 2
    assert "--write: expected no --no-fly" in capsys.readouterr().err


def test_rows_of_some_cases_are_renewed_and_the_others_stay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A page of two cases, of which one is flown anew: its row changes, and the page says whence each is."""
    stays, renewed = list(silence.cases())[-2:]
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "guarantees.md"
    rows = [[case.name, *(["-"] * (len(silence.HEADINGS) - 1))] for case in (stays, renewed)]
    before = table(silence.HEADINGS, rows)
    page.write_text(
        f"<!-- bench: silence -->\n{before}\n\n*Earlier.*\n<!-- end of bench: silence -->\n"
    )
    monkeypatch.setattr(silence, "ROOT", tmp_path)
    monkeypatch.setattr(silence, "origin", lambda: "Today")

    result = silence.Result(runs=1, completed=1, attitude_deg=2.0, separation_m=0.5)
    for _ in range(2):
        silence.write([(renewed, result)], only=renewed.name)
        lines = page.read_text().splitlines()
        assert lines[1:4] == before.splitlines()[:3]
        assert lines[4].startswith(f"| {renewed.name} | 1 of 1 | 2.0 deg | 0.500 m |")
        assert lines[5:7] == ["", f"*Earlier; rows with {renewed.name!r}: Today.*"]
