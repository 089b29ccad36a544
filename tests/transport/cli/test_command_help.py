"""Help, completion, defaults and refusals of the command line, the same for every command."""

import json
import os
import re
from importlib.resources import files
from pathlib import Path

import pytest
import typer
from typer.core import TyperCommand, TyperGroup
from typer.testing import CliRunner

from tests.support import runs
from tests.support.command_tree import every_command, root
from tests.support.logs import record_run
from transport.cli.lazy import LazyGroup
from transport.cli.main import app
from transport.cli.options import newest_runs
from transport.cli.setting_words import complete_setting
from transport.log.run_folder import point_latest
from transport.protocol.scenario.sections.scenario_keys import fields, section_in
from transport.protocol.scenario.sections.schema import Scenario

ONE_LINE = {
    "valdate paper": "no such command 'valdate'. Did you mean 'validate'? (transport --help)",
    "fault kil agent1": "'ACTION': 'kil' is not one of 'kill', 'stop', 'continue', 'restart'",
    "fault kill agent1": "no active run in runs/",
    "run --port x": "invalid value for '--port'",
    "run paper windy": "unexpected extra argument",
    "agent": "missing option '--id'",
    "link set --loss 2": "loss: expected a share, at most 1, got 2: did you mean 0.02?",
    "link set --distribution foo": "distribution: expected 'uniform', 'normal', 'exponential', 'lognormal' or",
    "view": "expected a run folder, got none, and there is no run in runs/",
    "plot": "expected a run folder, got none, and there is no run in runs/",
    "log info": "expected a run folder, got none, and there is no run in runs/",
    "replay --agent 1": "expected a run folder, got none, and there is no run in runs/",
    "compare": "expected at least two runs, got 0",
}
# Commands that print nothing, run until they are ended, or print more than one value.
NO_JSON = {"agent", "plant", "coordinator", "vehicle", "router", "ros2"}


def test_sections_hold_every_command_once() -> None:
    """The help has each command and group under exactly one heading."""
    group = root()
    assert isinstance(group, LazyGroup)
    assert sorted(name for names in group.sections.values() for name in names) == sorted(
        group.commands
    )
    shown = CliRunner().invoke(app, ["-h"]).stdout
    assert CliRunner().invoke(app, ["--help"]).stdout == shown
    for heading, names in group.sections.items():
        _, _, block = shown.partition(f"\n{heading}:\n")
        assert [line.split()[0] for line in block.partition("\n\n")[0].splitlines()] == list(names)


def test_commands_that_print_have_json() -> None:
    """Every command takes `--format json`, except processes of a run and the bridge to ROS 2, which write log lines."""
    without = {
        str(command.name)
        for command in every_command(root())
        if not isinstance(command, TyperGroup)
        and not any("--format" in option.opts for option in command.params)
    }
    assert without == NO_JSON


@pytest.mark.parametrize("words", ONE_LINE)
def test_errors_are_one_line(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A refused command line ends with exit code 2 and one line, whatever is running."""
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words.split())
    assert (result.exit_code, result.stdout) == (2, "")
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("transport: ")
    assert ONE_LINE[words] in result.stderr


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("transport exper", "experiment"),
        ("transport experiment loss --bur", "--burst"),
        ("transport run resi", "resilient"),
        ("transport fault st", "stop"),
        ("transport plot ru", "runs/b"),
        ("transport run resilient --set contr", "controller.sampling_period_s"),
        ("transport experiment loss --set links.measurement.de", "links.measurement.delay_s="),
    ],
)
def test_the_shell_completes(
    line: str, expected: str, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands, options, ready-made scenarios, faults and run folders are completed."""
    monkeypatch.chdir(recorded)
    asked = {
        "_TRANSPORT_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)
    }  # fmt: skip
    done = CliRunner().invoke(app, [], prog_name="transport", env=asked)
    assert done.stdout.splitlines()[:1] == [expected], done.stderr


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("controller.hor", ["controller.horizon=", "controller.horizon=20"]),
        ("clock.m", ["clock.mode=lockstep", "clock.mode=realtime"]),
        ("controller.preview=", ["controller.preview=true", "controller.preview=false"]),
        ("controller.preview=t", ["controller.preview=true"]),
        ("maneuver.phase.2.dur", ["maneuver.phase.2.duration_s=", "maneuver.phase.2.duration_s=5.0"]),
        ("links.change.3.at", ["links.change.3.at_s="]),
        ("controller.terminal", ["controller.terminal=multiple", "controller.terminal=riccati"]),
        ("no.such", []),
    ],
)  # fmt: skip
def test_the_shell_completes_settings(word: str, expected: list[str]) -> None:
    """A key is followed by its choices, or by nothing and the value that the scenario has."""
    context = typer.Context(TyperCommand("run"), info_name="run")
    context.params["scenario"] = "resilient"
    assert complete_setting(context, word) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run resilient --set controller.hor", ["controller.horizon=", "controller.horizon=20"]),
        ("run resilient --set controller.solver =", ["daqp", "clarabel"]),
        ("run resilient --set controller.solver = da", ["daqp"]),
        ("run resilient --set controller.horizon =", ["20"]),
        ("run resilient --set name =", ["resilient"]),
        ("run resilient --set name = ", ["resilient"]),  # a new word
        ("run resilient --set links.loss = 0.1 --set name =", ["resilient"]),
        ("run resilient --set maneuver.phase.0.dur", []),
        ("run resilient --set controller.solver=da", ["controller.solver=daqp"]),  # replaces all of it
        ("run resilient --set maneuver.phase.2.name =", ["climb"]),
        ("run resilient --set system.uav.4.mass_kg =", ["1.5"]),
        ("run resilient --set name='a", []),  # the quotation mark is open
        ("run resilient --set links.loss = 0.1 --set controller.preview = t", ["true"]),
        (
            "run resilient --set links.loss = 0.1 --set clock.m",
            ["clock.mode=lockstep", "clock.mode=realtime"],
        ),
        ("run resilient --set name =| --no-figures", ["resilient"]),  # the cursor is in the middle
        ("run resilient --set = clock.m", ["clock.mode=lockstep", "clock.mode=realtime"]),
        ("run resilient --set = clock.mode = real", ["realtime"]),
        ("run resilient --format = j", ["json"]),
        ("run --out = x resilient --set name =", ["resilient"]),
        ("run resilient paper --set name =", ["resilient"]),  # the first one
        ("experiment loss --set name =", ["paper"]),
        # Nothing is known of a scenario that there is not, and of a section that a scenario has not.
        ("run nosuch --set name =", []),
                ("run resilient --set radio.rate_mbps =", []),
        ("run resilient --set links.change.3.at_s =", []),
        ("run large.toml --set name =", ["large"]),  # beyond the limits without --allow-large
    ],
)  # fmt: skip
def test_bash_completes_what_is_behind_the_sign(
    words: str, expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """bash splits options and settings at their signs =, and replaces the part behind."""
    monkeypatch.chdir(tmp_path)
    large = runs.PAPER.read_text(encoding="utf-8").replace('name = "paper"', 'name = "large"')
    large = large.replace("duration_s = 5.0", "duration_s = 500000.0")
    Path("large.toml").write_text(large, encoding="utf-8")
    before, *behind = f"transport {words}".split("|")
    line = "".join([before, *behind])
    place = str(len(before.split()) - (not before.endswith(" ")))
    asked = {"_TRANSPORT_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": place}
    done = CliRunner().invoke(app, [], prog_name="transport", env=asked)
    assert done.exit_code == 0, done.exception
    assert done.stdout.split() == expected, done.stderr


def test_zsh_splits_no_setting() -> None:
    """It gives the line as it is, and replaces whole words."""
    asked = {
        "_TRANSPORT_COMPLETE": "complete_zsh",
        "_TYPER_COMPLETE_ARGS": "transport run resilient --set controller.preview=t",
    }
    done = CliRunner().invoke(app, [], prog_name="transport", env=asked)
    assert done.exit_code == 0, done.exception
    assert '"controller.preview=true"' in done.stdout


def test_the_shell_completes_scenarios() -> None:
    """Names of ready scenarios are those of the folder that a wheel has, too."""
    asked = {
        "_TRANSPORT_COMPLETE": "complete_bash",
        "COMP_WORDS": "transport run re",
        "COMP_CWORD": "2",
    }
    done = CliRunner().invoke(app, [], prog_name="transport", env=asked)
    assert done.stdout.split() == ["resilient"]
    assert (Path(str(files("transport"))) / "scenarios" / "resilient.toml").is_file()


def test_every_key_is_completed() -> None:
    """Each value of a scenario is a key that the shell completes to, lists with the number 1."""
    context = typer.Context(TyperCommand("run"), info_name="run")
    words = {re.sub(r"\.1\b", "", word) for word in complete_setting(context, "")}
    known = fields(Scenario)
    assert words == {key for key, field in known.items() if section_in(field.annotation) is None}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder whose `runs/` has two runs, `b` the newer one, and the link to it."""
    home = tmp_path_factory.mktemp("newest")
    for place, name in enumerate(("a", "b")):
        folder = home / "runs" / name
        folder.mkdir(parents=True)
        record_run(runs.setup(runs.SHORT), folder)
        os.utime(folder / "run.mcap", (place, place))
        point_latest(folder)
    return home


def test_the_newest_run_is_the_default(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a run folder a command takes the most recent one and says so.

    A name in runs/ does as well.
    """
    monkeypatch.chdir(recorded)
    assert [folder.name for folder in newest_runs()] == ["b", "a"]
    result = CliRunner().invoke(app, ["log", "info", "--format", "json"])
    assert json.loads(result.stdout)["file"] == str(Path("runs") / "b" / "run.mcap")
    assert result.stderr == f"run: {Path('runs') / 'b'}\n"
    named = CliRunner().invoke(app, ["log", "info", "a", "--format", "json"])
    assert json.loads(named.stdout)["file"] == str(Path("runs") / "a" / "run.mcap")
    assert named.stderr == ""


def test_latest_is_a_link_to_the_newest_run(recorded: Path, tmp_path: Path) -> None:
    """`runs/latest` names the newest run, is replaced, and leaves a folder of that name and other places alone."""
    assert (recorded / "runs" / "latest").readlink() == Path("b")
    (tmp_path / "runs" / "latest").mkdir(parents=True)
    point_latest(tmp_path / "runs" / "c")
    assert not (tmp_path / "runs" / "latest").is_symlink()
    point_latest(tmp_path / "elsewhere" / "c")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["latest", "runs"]
