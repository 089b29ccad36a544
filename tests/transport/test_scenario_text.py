"""Scenarios as text: whatever is written reads back as it was, however it is commented."""

from pathlib import Path

import pytest

from protocol.scenario.file import read_scenario
from protocol.scenario.team import given
from tests.support.runs import PAPER, SCENARIOS
from transport.cli.scenario import scenario_text

# One of everything that is written in a way of its own: tables in tables, lists of lists, texts with brackets.
EVERYTHING = (
    "controller.constraint=[{expression='r1[2] >= -12.0'}, {expression='thrust1 <= 40', soft=false}]",
    "agents.owned=[[1, 2], [4, 3]]",
    "system.payload.inertia_kgm2=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
    "links={loss=0.1, gilbert_elliott={enter=0.1, leave=0.5}, override=[{from='agent1', delay_s=1e-7, "
    "gilbert_elliott={enter=0.2, leave=0.5}}], partition=[{between=['agent1', 'agent2'], start_s=1, end_s=2}]}",
    r"""maneuver.phase.1.name="a \"quoted\" [name], with # and \n and \u0007" """,
    "network.base_port=7000",
)


@pytest.mark.parametrize("settings", [(), EVERYTHING])
@pytest.mark.parametrize("ready", ["paper", "centralized", "resilient"])
def test_text_reads_back(ready: str, settings: tuple[str, ...], tmp_path: Path) -> None:
    """Written text reads back as an equal scenario with the same explicit keys."""
    scenario = read_scenario(SCENARIOS / f"{ready}.toml", settings)
    path = tmp_path / "scenario.toml"
    path.write_text(scenario_text(given(scenario), ["by a test"]), encoding="utf-8")
    again = read_scenario(path)
    assert again == scenario
    assert given(again) == given(scenario)


@pytest.mark.parametrize("comment", ["", "plain", "two\nlines", "\0\a\x7f\r", "name = 3", "\ud800", "[system]"])
def test_comments_are_only_comments(comment: str, tmp_path: Path) -> None:
    """Nothing in a comment changes the scenario, not even what no file may hold."""
    scenario = read_scenario(PAPER)
    path = tmp_path / "scenario.toml"
    path.write_text(scenario_text(given(scenario), [comment, "second"]), encoding="utf-8")
    assert read_scenario(path) == scenario
    assert path.read_text(encoding="utf-8").splitlines()[1] == "# second"
