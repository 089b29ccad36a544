"""`transport validate`, `margins` and `scenario new`: what they tell, and what they hand on."""

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
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
        (("paper", "--set", "radio={offsets='none'}"), ["valid: ", LAWS, "size: "]),
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
    assert tomllib.loads(result.stdout)["name"] == words[0]
    lines = result.stderr.splitlines()
    assert ", digest " in lines[0]
    assert lines[0].endswith("controller mpc")
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


def test_slots_are_told_by_kind_of_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents with plans of their own have slots of their own; a run without a radio has no slots."""

    def slots_of(_run: object, shape: str) -> Any:
        return SimpleNamespace(are_enough=shape != "long", text=lambda: shape)

    shapes = {"agent 1: ": "short", "agent 2: ": "long"}
    monkeypatch.setattr(commands, "plan_shapes", lambda _: shapes)
    monkeypatch.setattr(commands, "slot_lengths", slots_of)
    told = ["radio: agent 1: short", "radio, warning: agent 2: long"]
    assert list(commands._slots_in_words(ready("paper", "radio={}"))) == told
    assert list(commands._slots_in_words(ready("paper"))) == []


# UAVs at unequal distances from the centre of mass: the front ones carry 23.30 N, the others 20.85 N.
UNEQUAL = [
    f"{{id={number},mass_kg=1.5,inertia_kgm2=[0.029,0.029,0.055],rho_m=[{x_m},{y_m},-0.125],rod_length_m=3.2}}"
    for number, (x_m, y_m) in enumerate(
        ((0.25, 0.25), (0.25, -0.25), (-0.35, -0.25), (-0.35, 0.25)), 1
    )
]


@pytest.mark.parametrize(
    ("largest_N", "settings", "told"),
    [
        (26.2, (), "thrust 22.07 N"),
        (25.7, (), "thrust 22.07 N (86% of the limit: little is left to manoeuvre)"),
        (
            27.0,
            (f"system.uav=[{','.join(UNEQUAL)}]",),
            "thrusts 23.30, 23.30, 20.85, 20.85 N (86% of the limit: little is left to manoeuvre)",
        ),
    ],
)
def test_little_thrust_to_manoeuvre_is_told(
    largest_N: float, settings: tuple[str, ...], told: str
) -> None:
    """Above 85 % of the largest thrust of the UAV that carries most."""
    limit = f"controller.limits.thrust_N=[0.0,{largest_N}]"
    assert hover_thrusts(ready("paper", *settings, limit)) == f"hover {told}"


@pytest.mark.parametrize(("factor", "is_wide"), [(0.99, False), (1.01, True)])
def test_a_load_is_wide_beyond_its_outermost_attachment(factor: float, is_wide: bool) -> None:
    """About the vertical axis, by its moment of inertia about that and horizontal distances."""
    far, near = SimpleNamespace(rho=np.array([3.0, 4.0, -9.0])), SimpleNamespace(rho=np.ones(3))
    inertia = np.diag([1e-3, 1e3, 2.0 * (factor * 5.0) ** 2])
    team = SimpleNamespace(
        payload=SimpleNamespace(inertia=inertia, mass=2.0), uavs=[near, far, near]
    )
    setup: Any = SimpleNamespace(system=team)
    assert bool(commands.wide_load(setup)) is is_wide


@pytest.mark.parametrize(
    "words", [("validate", "eight"), ("margins", "eight"), ("doctor", "eight")]
)
@pytest.mark.parametrize("large", [False, True])
def test_a_large_run_needs_its_option(
    words: Sequence[str], large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is handed on by each command, with the changes."""
    asked: list[Any] = []

    def read_setup(name: str, settings: Sequence[str], *, allow_large: bool) -> None:
        asked.append((name, list(settings), allow_large))
        raise TransportError("enough")

    monkeypatch.setattr(commands, "read_setup", read_setup)
    here(*words, "--set", "seed=3", *(["--allow-large"] if large else []))
    assert asked == [("eight", ["seed=3"], large)]


def test_a_team_that_is_large_is_run_with_an_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command that is told accepts it, and why it must is told before; the file is in the JSON."""

    def check_size(*_: object) -> None:
        raise ScenarioError("six.toml", "agents", "too many")

    def made(name: str) -> tuple[Any, Path]:
        path = tmp_path / name
        new = ("scenario", "new", "--uavs", "3", "--from", "paper", "--groups", "2")
        return here(*new, "--format", "json", "--out", path), path

    small, path = made("a small.toml")
    assert small.stderr.startswith("3 UAVs, 2 agents, hover thrust ")
    assert f"run it with: transport run '{path}'\n" in small.stderr
    assert json.loads(small.stdout)["file"] == str(path)
    monkeypatch.setattr(commands, "check_size", check_size)
    large, path = made("large.toml")
    why, command, *_ = large.stderr.splitlines()
    assert "too many" in why
    assert command.endswith(f"run it with: transport run {path} --allow-large")


def test_a_template_may_be_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """The new team need not be."""
    asked: list[bool] = []

    def template(_name: str, *, allow_large: bool = False) -> None:
        asked.append(allow_large)
        raise TransportError("enough")

    monkeypatch.setattr(commands, "Scenario", template)
    here("scenario", "new", "--uavs", "3")
    assert asked == [True]


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
