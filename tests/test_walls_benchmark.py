"""The benchmark of walls seen in flight: what it draws, and what it counts."""

from dataclasses import replace

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
