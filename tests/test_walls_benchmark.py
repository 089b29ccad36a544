"""The benchmark of walls seen in flight: what it draws, and what it counts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import walls
from benchmarks.walls import Flown, cells, scene
from transport.protocol.scenario.sections.scenario_errors import ScenarioError

ROUND = Flown(arrives=True, rests=False, uav_m=0.5, load_m=0.2, attitude_deg=1.0, apart_m=0.4)
RESTS = replace(ROUND, arrives=False, rests=True, attitude_deg=2.0)


def test_each_end_counts_and_distances_are_the_least() -> None:
    """A rest is no way round, a margin is less than a contact, and a load can touch where no UAV does."""
    near = replace(ROUND, uav_m=0.39)
    touched = replace(RESTS, load_m=-0.01, apart_m=0.3)
    found = cells([ROUND, RESTS, near, touched])
    assert found == [
        *("2 of 4", "2", "1", "2 of 4"),
        *("0.39 m", "-0.01 m", "2.0 deg", "0.30 m"),
    ]


def test_walls_are_across_the_path() -> None:
    """Each wall of the table would be refused if it were known; no two scenes are equal."""
    scenes = [scene(seed) for seed in range(100, 120)]
    assert len(set(scenes)) == len(scenes)
    for settings in scenes[:3]:
        known = [setting.replace(f",seen_within_m={walls._SIGHT_M}", "") for setting in settings]
        with pytest.raises(ScenarioError, match=r"obstacle\.1"):
            walls.prepared(*known)


def test_a_silence_begins_with_the_sight_of_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all agents, for 3 s, on top of the settings of its row; other rows have no silence."""

    def prepared(*settings: str) -> Any:
        return SimpleNamespace(settings=settings, scenario=SimpleNamespace(owned=[[1], [2], [3]]))

    monkeypatch.setattr(walls, "prepared", prepared)
    monkeypatch.setattr(walls, "sight_s", lambda _setup: 4.5)
    for row, settings in walls.ROWS.items():
        given: Any = walls.setup_of(row, 100)
        times = "start_s=4.5,end_s=7.5"
        cuts = f"{{between=['agent1'],{times}}},{{between=['agent2'],{times}}}"
        silence = [f"links.partition=[{cuts}]"] if "silence" in row else []
        assert given.settings == (*scene(100), *settings, *silence)
