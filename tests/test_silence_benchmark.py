"""The benchmark of silent networks: its measure of errors, and kept runs."""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import silence
from benchmarks.silence import Case, Flown, Kept
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


def test_only_a_whole_table_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    """A selection of cases would leave the page without the others: it is refused."""
    with pytest.raises(SystemExit) as caught:
        silence.main(["--case", "eight", "--write"])
    assert caught.value.code == 2
    assert "--write: expected neither --case nor --no-fly" in capsys.readouterr().err
