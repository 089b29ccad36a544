"""Values of options that no run can use are refused before anything starts, by name."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from typer.testing import CliRunner, Result

from tests.support import runs
from tests.support.command_tree import root
from transport.cli import lazy, options
from transport.cli.lazy import Command
from transport.cli.main import app
from transport.cli.options import forget_setup, process_setup, read_setup, run_folder
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
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


def raising(error: Exception, *words: str) -> Result:
    """Return how a command with settings ends that raises an error."""
    single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

    @single.command(cls=Command)
    def command(settings: list[str] = typer.Option([], "--set")) -> None:
        raise error

    return CliRunner().invoke(single, words)


REFUSED = ScenarioError("paper.toml", "links.loss", "expected at most 1, got 7")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (TransportError("no"), TransportError.exit_code, "no"),
        (REFUSED, REFUSED.exit_code, str(REFUSED)),
        (FileNotFoundError(2, "No such file", "a.toml"), 2, "a.toml: No such file"),
        (
            ModuleNotFoundError(name="pyarrow"),
            2,
            "expected the package pyarrow, got none: pip install 'payload-transport[parquet]'",
        ),
    ],
)
def test_an_error_that_the_user_can_solve_is_one_line(
    error: Exception, code: int, text: str
) -> None:
    """With its exit code, on standard error."""
    ended = raising(error)
    assert (ended.exit_code, ended.stdout, ended.stderr) == (code, "", f"transport: {text}\n")


@pytest.mark.parametrize(
    "error", [OSError("odd"), ModuleNotFoundError(name="transport.nowhere"), ValueError("odd")]
)
def test_another_error_keeps_its_traceback(error: Exception) -> None:
    """It is a bug."""
    assert raising(error).exception is error


def test_a_folder_that_is_gone_and_a_setting_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are the cause of an error, which does not name them itself."""
    setting = "links.loss=7"
    told = raising(REFUSED, "--set", setting).stderr
    assert told == f"transport: {REFUSED.blaming([setting])}\n"
    assert setting in told
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    expected = "expected a current folder, got one that has been removed"
    assert raising(OSError("odd")).stderr == f"transport: {expected}\n"


@pytest.mark.parametrize("words", [[], ["log"]])
def test_without_a_command_the_help_is_shown(words: list[str]) -> None:
    """As an error, which it is for a script."""
    shown = CliRunner().invoke(app, words)
    assert (shown.exit_code, shown.stdout) == (2, "")
    assert shown.stderr.strip() == CliRunner().invoke(app, [*words, "--help"]).stdout.strip()


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ("Input should be a\n number.", "expected a number, got 'x'"),
        ("Value error, 'x' is no number", "'x' is no number"),
    ],
)
def test_a_value_of_an_option_is_told_once(message: str, text: str) -> None:
    """In the words of all errors."""
    cause = SimpleNamespace(errors=lambda: [{"input": "x"}])
    error = SimpleNamespace(format_message=lambda: message)
    error.__cause__ = cause
    assert lazy._usage_problem(error) == text


def test_a_command_is_imported_once_and_left_out_of_collections(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Collections go on after the import, also if that fails."""
    group = root()
    assert isinstance(group, lazy.LazyGroup)
    assert group.load("validate") is group.load("validate")
    called: list[str] = []
    steps = ("disable", "freeze", "enable")
    note = {name: lambda name=name: called.append(name) for name in steps}
    monkeypatch.setattr(lazy, "gc", SimpleNamespace(**note))
    lazy.load("json")
    with pytest.raises(ModuleNotFoundError):
        lazy.load("transport.nowhere")
    assert called == [*steps, *steps]
