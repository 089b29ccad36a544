"""The benchmark of walls seen in flight: what it draws, and what it counts."""

import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from benchmarks import walls
from benchmarks.walls import Flown, cells, scene
from tests.support import runs
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


@pytest.mark.parametrize("by_m", [0.0, -1e-9])
def test_a_margin_is_kept_at_its_end_and_a_contact_begins_at_zero(by_m: float) -> None:
    """By UAVs and by rods and payload."""
    held = replace(ROUND, uav_m=walls.MARGIN_M + by_m, load_m=walls.LOAD_MARGIN_M)
    below = replace(ROUND, uav_m=walls.MARGIN_M, load_m=walls.LOAD_MARGIN_M + by_m)
    assert held.keeps_margins is below.keeps_margins is (by_m == 0.0)
    assert replace(ROUND, load_m=by_m).touches
    assert not replace(ROUND, uav_m=1e-9).touches


def test_walls_stand_along_the_path_in_its_own_direction() -> None:
    """6 to 9 m along it, at most 1 m beside, and turned by at most 60 deg from across it; seen from 3 m."""
    for seed in range(100, 140):
        maneuver, obstacle, chosen = scene(seed)
        way = np.array(
            tomllib.loads(maneuver.replace("maneuver.phase", "p"))["p"][1]["points_m"][0]
        )
        (wall,) = tomllib.loads(obstacle)["obstacle"]
        forward = way[:2] / np.linalg.norm(way)
        place = np.array(wall["at_m"][:2])
        assert 6.0 <= place @ forward <= 9.0
        assert abs(forward[0] * place[1] - forward[1] * place[0]) <= 1.001
        turn_deg = wall["heading_deg"] - math.degrees(math.atan2(forward[1], forward[0]))
        assert abs((turn_deg + 180.0) % 360.0 - 180.0) <= 60.1
        assert (wall["seen_within_m"], chosen) == (3.0, f"seed={seed}")


def test_the_sight_of_a_wall_is_the_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """In scenario time; a wall that no UAV sees ends the program."""
    run = runs.setup()
    blind = [runs.measurement(run, 1, tick) for tick in range(4)]
    sees = [structs.replace(one, seen=np.ones(8)) for one in blind[2:]]
    ticks: list[int] = []

    def simulate(_setup: Any, watch: Callable[[Any], None]) -> None:
        for message in sent:
            ticks.append(message.tick)
            watch(message)

    monkeypatch.setattr(walls, "simulate", simulate)
    sent: list[Any] = [runs.plant_state(run, 0), *blind[:2], *sees]
    assert walls.sight_s(run) == pytest.approx(2 * run.settings.sampling_period_s)
    assert ticks[-1] == 2  # the run ends there
    sent = blind
    with pytest.raises(SystemExit, match="expected a wall in sight, got none"):
        walls.sight_s(run)


@pytest.mark.parametrize(
    ("words", "flown", "count"),
    [
        (["--row", "perfect"], range(100, 120), 0),
        (["--row", "perfect", "--first", "7", "--seeds", "2", "--write"], range(7, 9), 1),
    ],
)
def test_rows_and_seeds_are_those_that_are_asked_for(
    words: list[str], flown: range, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page is renewed only if that is asked for."""
    done: list[Any] = []
    written: list[Any] = []

    def fly(row: str, seed: int) -> Flown:
        done.append((row, seed))
        return ROUND

    monkeypatch.setattr(walls, "fly", fly)
    monkeypatch.setattr(walls, "put_rows", lambda *given: written.append(given[4]))
    walls.main(words)
    assert done == [("perfect network", seed) for seed in flown]
    assert written == [{"perfect network": cells([ROUND] * len(flown))}] * count


def test_the_least_distance_of_two_uavs() -> None:
    """At any instant, of any pair: the paper's UAVs are 0.5 m apart."""
    run = runs.setup()
    x = np.array([run.hover.x, run.hover.x])
    assert walls._apart_m(run, x) == pytest.approx(0.5)


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
