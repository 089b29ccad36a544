"""`transport validate`, `margins` and `scenario new`: what they tell, and what they hand on."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.results import here
from tests.support.runs import ready
from transport.cli.commands import scenario as commands
from transport.cli.commands.scenario import hover_thrusts
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.wire.errors_and_exit_codes import TransportError

LAWS = "laws: as they are"
SHORT_SLOTS = ("--set", "controller.sampling_period_s=0.01", "--set", "controller.horizon=60")
LATE_FAULT = "faults.event=[{at_s=900.0,do='kill',target='agent1'}]"


@pytest.fixture(autouse=True)
def _known_laws(monkeypatch: pytest.MonkeyPatch) -> None:
    """The laws of a team take seconds, and have tests of their own."""
    monkeypatch.setattr(commands, "in_words", lambda _: iter([LAWS]))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("paper",), ["valid: 4 UAVs, 4 agents, 500 ticks, hover thrust 22.07 N", LAWS, "size: "]),
        (
            ("paper", "--set", LATE_FAULT),
            ["valid: ", LAWS, "warning: faults.event.1.at_s: 900 s is after the last tick", "size: "],
        ),
        (
            ("resilient", "--set", "controller.alone.swing=8.0"),
            ["valid: ", LAWS, "warning: UAVs alone do not hold this team", "size: "],
        ),
        (("paper", "--set", "radio={}"), ["valid: ", "radio: a plan of", LAWS, "size: "]),
        (
            ("paper", "--set", "radio={}", *SHORT_SLOTS),
            ["valid: ", "radio, warning: a plan of", LAWS, "size: "],
        ),
        (
            ("paper", "--explain"),
            ["valid: ", "closest", "nearest limit", "", LAWS, "size: "],
        ),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_valid_scenario_is_told_in_lines(words: Sequence[str], told: list[str]) -> None:
    """Its size and hover, then radio, limits, laws and warnings, as far as there are some, and its work."""
    result = here("validate", *words)
    assert result.exit_code == 0
    lines = result.stderr.splitlines()
    assert len(lines) == len(told), lines
    for line, beginning in zip(lines, told, strict=True):
        assert line.startswith(beginning)


def test_the_laws_of_a_large_team_are_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would take minutes."""
    for most, is_told in ((4, True), (3, False)):
        monkeypatch.setattr(commands, "MOST_UAVS", most)
        assert (LAWS in here("validate", "paper").stderr) is is_told


def test_json_has_the_limits_only_if_they_are_asked_for() -> None:
    """And the scenario with its digest; nothing is told beside it."""
    digest = ready("paper").scenario.digest()
    for words, is_explained in (((), False), (("--explain",), True)):
        result = here("validate", "paper", "--format", "json", *words)
        content = json.loads(result.stdout)
        assert (content["scenario"]["name"], content["digest"]) == ("paper", digest)
        assert ("explained" in content) is is_explained
        assert result.stderr == ""


@pytest.mark.parametrize(("largest_N", "is_little"), [(26.2, False), (25.7, True)])
def test_little_thrust_to_manoeuvre_is_told(largest_N: float, is_little: bool) -> None:
    """Above 85 % of the largest thrust of a UAV; hover takes 22.07 N of each."""
    text = hover_thrusts(ready("paper", f"controller.limits.thrust_N=[0.0,{largest_N}]"))
    assert text.startswith("hover thrust 22.07 N")
    assert ("little is left to manoeuvre" in text) is is_little


def test_a_team_that_is_large_is_run_with_an_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command that is told accepts it, and why it must is told before; the file is in the JSON."""

    def check_size(*_: object) -> None:
        raise ScenarioError("six.toml", "agents", "too many")

    def made(name: str) -> tuple[Any, Path]:
        path = tmp_path / name
        new = ("scenario", "new", "--uavs", "3", "--from", "paper", "--format", "json", "--out")
        return here(*new, path), path

    small, path = made("small.toml")
    assert f"run it with: transport run {path}\n" in small.stderr
    assert json.loads(small.stdout)["file"] == str(path)
    monkeypatch.setattr(commands, "check_size", check_size)
    large, path = made("large.toml")
    why, command, *_ = large.stderr.splitlines()
    assert "too many" in why
    assert command.endswith(f"run it with: transport run {path} --allow-large")


def test_margins_are_those_without_the_agents_that_are_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numbers with commas between, and blanks beside them; all agents are there by default."""
    absent: list[Sequence[int]] = []

    def hover_margins(_setup: object, gone: Sequence[int]) -> None:
        absent.append(gone)
        raise TransportError("enough")

    monkeypatch.setattr("transport.report.margins.hover_margins", hover_margins)
    for words in ((), ("--without", "1, 3")):
        here("margins", "resilient", *words)
    assert absent == [[], [1, 3]]
