"""Values of options that no run can use are refused before anything starts, by name."""

import os
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from tests.support import runs
from transport.cli import options
from transport.cli.main import app
from transport.cli.options import forget_setup, process_setup, read_setup, run_folder
from transport.protocol.wire.errors_and_exit_codes import TransportError


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["view", "none", "--host", ""], "--host: expected an address"),
        (["run", "paper", "--view", "--host", " "], "--host: expected an address"),
        (["agent", "--id", "1", "--join-timeout", "inf"], "--join-timeout: expected 0 to 1e+06 s"),
        (
            ["agent", "--id", "1", "--join-timeout", "nan"],
            "'--join-timeout': expected greater than or equal to 0, got 'nan'",
        ),
    ],
)
def test_a_value_that_cannot_be_used_is_refused(
    arguments: list[str], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty address, which would listen on all, and an endless timeout end the command with code 2."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert problem in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("second", "runs/second"),
        ("runs/second", "runs/second"),
        ("first", "first"),  # the one here comes before that in runs/
        ("elsewhere", "elsewhere"),
        ("secnd", "secnd: no such run; did you mean second?"),
        ("runs/secnd", "runs/secnd: no such run; did you mean runs/second?"),
        ("zzz", "zzz: no such run, neither here nor in runs/"),
        (
            "many",
            "runs/many: expected a run folder, got one of an experiment, whose results are in report.md and "
            "points.csv",
        ),
    ],
)
def test_a_run_is_found_by_its_folder_or_name(
    given: str,
    found: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An experiment is none, and for a wrong name a similar one is told."""
    monkeypatch.chdir(tmp_path)
    for name in ("first", "elsewhere", "runs/first", "runs/second", "runs/many"):
        Path(name).mkdir(parents=True)
        (Path(name) / "run.mcap").touch()
    Path("runs/many/experiment.json").touch()
    if ": " not in found:
        assert run_folder(Path(given)) == Path(found)
        return
    with pytest.raises(typer.Exit) as refused:
        run_folder(Path(given))
    assert refused.value.exit_code == 2
    assert capsys.readouterr().err == f"transport: {found}\n"


def test_a_setup_is_kept_until_its_file_or_a_value_changes(tmp_path: Path) -> None:
    """Or the model has been compiled meanwhile; that of a process at a set speed has splines ready."""
    path = tmp_path / "own.toml"
    path.write_bytes(runs.PAPER.read_bytes())
    one = read_setup(str(path))
    assert read_setup(str(path)) is one
    assert read_setup(str(path), ["seed=3"]).scenario.seed == 3
    one = read_setup(str(path))
    forget_setup()
    assert read_setup(str(path)) is not one

    path.write_text(path.read_text(encoding="utf-8").replace("attitude = 5.0", "attitude = 4.0"))
    os.utime(path, (1, 1))
    assert read_setup(str(path)).scenario.controller.weights.attitude == 4.0


@pytest.mark.parametrize("large", [False, True])
def test_a_large_run_is_read_if_it_is_allowed(large: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the commands and by the processes of a run."""
    asked: list[bool] = []

    def read(_path: Path, _settings: object, *, allow_large: bool) -> None:
        asked.append(allow_large)
        raise TransportError("enough")

    monkeypatch.setattr(options, "read_scenario", read)
    for reads in (read_setup, process_setup):
        with pytest.raises(TransportError, match="enough"):
            reads("paper", ["seed=7"], allow_large=large)
    assert asked == [large, large]


@pytest.mark.parametrize(("speed", "loaded"), [(0.0, []), (0.5, ["scipy.interpolate"])])
def test_splines_are_imported_before_a_paced_run(
    speed: float, loaded: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As fast as possible the first target imports them."""
    asked: list[str] = []
    monkeypatch.setattr(options, "load", asked.append)
    process_setup("paper", [f"clock={{mode='realtime',speed={speed}}}"] if speed else [])
    assert asked == loaded
