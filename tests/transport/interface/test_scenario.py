"""A `transport.Scenario` is valid at any time: each change is made as a whole or refused."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import transport
from transport.interface.setting_arguments import settings_of
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

READY = sorted(path.stem for path in find_scenario("paper").parent.glob("*.toml"))


@pytest.mark.parametrize("name", READY)
def test_it_is_the_scenario_of_the_command_line(name: str) -> None:
    """Without changes the tree and the fingerprint are those of the file, also after saving."""
    scenario = transport.Scenario(name)
    assert scenario.tree() == read_scenario(find_scenario(name)).tree()
    assert scenario.copy() == scenario


def test_a_saved_scenario_is_the_same(tmp_path: Path) -> None:
    """A file that was written reads back equal, and is not replaced."""
    scenario = transport.Scenario("resilient", {"links.delay_s": 1.0 / 3.0}, horizon=12)
    path = scenario.save(tmp_path / "mine.toml")
    assert transport.Scenario(path).digest() == scenario.digest()
    with pytest.raises(FileExistsError):
        scenario.save(path)


def test_a_saved_scenario_is_the_same_in_any_folder(tmp_path: Path) -> None:
    """Tables that a scenario names, relative to its folder, are in the saved file as numbers."""
    source = tmp_path / "source"
    source.mkdir()
    (source / "d.csv").write_text("0.1 0.2", encoding="utf-8")
    ready = find_scenario("resilient").read_text(encoding="utf-8")
    measured = '\n[links]\ndistribution = "empirical"\nsamples_s = "d.csv"\n'
    (source / "mine.toml").write_text(ready + measured, encoding="utf-8")

    scenario = transport.Scenario(source / "mine.toml")
    moved = transport.Scenario(scenario.save(tmp_path / "moved.toml"))
    assert moved.links.samples_s == (0.1, 0.2)
    assert moved.digest() == scenario.digest()


CHANGES: list[tuple[str, Any]] = [
    ("links.delay_s", 0.25),
    ("links.delay_s", np.float64(0.1)),
    ("controller.horizon", np.int64(7)),
    ("controller.solver", "clarabel"),
    ("controller.disturbance.estimate", True),
    ("agents.owned", [[1, 2], (3, 4)]),
    ("plant.wind.gust_mps", np.array([1.0, 0.5, 0.0])),
    ("system.uav.2.mass_kg", 1.7),
    ("controller.tilt", {"limit_deg": 20.0}),
    ("controller.constraint", [{"expression": "r0[2] >= -12.0", "penalty": 5.0}]),
    ("faults.event", [{"at_s": 3.0, "do": "release", "target": "uav1"}]),
]


@pytest.mark.parametrize(("key", "value"), CHANGES)
def test_a_change_is_that_of_the_command_line(key: str, value: Any) -> None:
    """A Python value gives the same scenario as `--set key=value`, floats to the last bit."""
    scenario = transport.Scenario("resilient")
    scenario[key] = value
    (text,) = settings_of({key: value}, {})
    assert scenario.tree() == read_scenario(find_scenario("resilient"), [text]).tree()
    assert scenario != transport.Scenario("resilient")


REFUSED = [
    ({"links.delay_s": -1.0}, "links.delay_s=-1.0: expected greater than or equal to 0, got -1.0"),
    ({"controller.horizn": 3}, "controller.horizn=3: unknown key; did you mean 'horizon'?"),
    ({"controller.limits.thrust_N": [0.0, 5.0]}, "expected a range that contains the hover thrust"),
    ({"agents.owned": [[1, 2], [3]]}, "expected each UAV of [1, 2, 3, 4] once, got [1, 2, 3]"),
]


@pytest.mark.parametrize(("settings", "text"), REFUSED)
def test_a_refused_change_leaves_it_as_it_was(settings: dict[str, Any], text: str) -> None:
    """A value out of range, a mistyped key, an impossible hover, a broken relation.

    One line, and nothing changes.
    """
    scenario = transport.Scenario("resilient")
    with pytest.raises(transport.ScenarioError) as caught:
        scenario.set(settings)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert scenario == transport.Scenario("resilient")


def test_changes_that_are_valid_only_together() -> None:
    """`set` takes several at once; one of them alone is refused."""
    scenario = transport.Scenario("paper")
    with pytest.raises(
        transport.ScenarioError, match="expected measured delays beside empirical, got nothing"
    ):
        scenario.links.distribution = "empirical"
    scenario.set({"links.distribution": "empirical", "links.samples_s": [0.1]})
    assert scenario.links.samples_s == (0.1,)


def test_sections_are_attributes() -> None:
    """Sections read and write.

    List entries count from 0, in dotted keys from 1; lists cannot be changed unnoticed.
    """
    scenario = transport.Scenario("resilient")
    links = scenario.links
    links.delay_s = 0.3
    assert (links.delay_s, scenario.links.delay_s, scenario["delay_s"]) == (0.3, 0.3, 0.3)
    scenario.system.uav[1].mass_kg = 1.75
    assert scenario["system.uav.2.mass_kg"] == 1.75
    assert isinstance(scenario.system.uav[0].rho_m, tuple)
    with pytest.raises(AttributeError, match=r"links.delay: unknown key; did you mean 'delay_s'"):
        _ = scenario.links.delay
    with pytest.raises(transport.ScenarioError, match="unknown key; did you mean 'delay_s'"):
        scenario.links.delay = 0.1
    with pytest.raises(transport.ScenarioError, match="unknown key; known: 1, 2, 3, 4"):
        _ = scenario["system.uav.9.mass_kg"]
    assert {"links", "resized"} <= set(dir(scenario))


@pytest.mark.parametrize(
    ("made", "sizes"),
    [
        (transport.Scenario("centralized"), "4 UAVs, 1 agent, 25 s"),
        (transport.Scenario("resilient").resized(2), "2 UAVs, 2 agents, 25 s"),
    ],
)
def test_a_scenario_is_told_by_its_sizes(made: transport.Scenario, sizes: str) -> None:
    """With its name, the number of UAVs and agents, and the duration."""
    assert repr(made) == f"Scenario({made.name!r}: {sizes})"


def test_listed_attributes_can_be_read() -> None:
    """`dir` has the keys of a section as they are read, also `from`, which Python reserves."""
    scenario = transport.Scenario(
        "resilient", {"links.override": [{"from": "agent1", "loss": 0.1}]}
    )
    link = scenario.links.override[0]
    listed = set(dir(link))
    assert {"from", "to", "loss"} <= listed
    for name in listed:
        assert name.startswith("_") or hasattr(link, name), name
    assert getattr(link, "from") == "agent1"


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, transport.Scenario.copy])
def test_a_copy_is_a_scenario_of_its_own(
    copied: Callable[[transport.Scenario], transport.Scenario],
) -> None:
    """A change of a copy, by its sections, leaves the original as it was, and the other way round."""
    scenario = transport.Scenario("resilient")
    other = copied(scenario)
    other.links.delay_s = 0.2
    scenario.links.loss = 0.1
    assert (scenario.links.delay_s, scenario.links.loss) == (0.0, 0.1)
    assert (other.links.delay_s, other.links.loss) == (0.2, 0.0)


def test_large_runs_stay_allowed() -> None:
    """A copy may be as large as its source, or as its own `allow_large` says."""
    large = {"plant.step_s": 1e-6}
    for allowed in (
        transport.Scenario("resilient", large, allow_large=True),
        transport.Scenario(transport.Scenario("resilient"), large, allow_large=True),
    ):
        for scenario in (allowed.copy(), allowed.resized(3)):
            scenario.links.delay_s = 0.2
            assert scenario.plant.step_s == 1e-6
    with pytest.raises(transport.ScenarioError, match="--allow-large admits more"):
        transport.Scenario("resilient").copy(large)


def test_a_team_of_another_size_keeps_its_vehicle(tmp_path: Path) -> None:
    """UAVs and limits are of one vehicle; a refused limit names the vehicle's file."""
    larger = transport.team(4, vehicle="racing").resized(6)
    assert larger.system == transport.team(6, vehicle="racing").system
    assert transport.team(4, vehicle="x500", load_kg=3).resized(6).system.uav[5].mass_kg == 2.0

    heavier = {f"system.uav.{number}.mass_kg": 1.6 for number in (1, 2, 3, 4)}
    assert transport.Scenario("resilient", heavier).resized(6).system.uav[5].mass_kg == 1.6

    file = tmp_path / "weak.toml"
    file.write_text(
        "name='weak'\ncontroller.limits.thrust_N=[0.0,15.0]\n"
        "uav={mass_kg=1.2,inertia_kgm2=[0.01,0.01,0.02],rod_length_m=2.0,spacing_m=0.8}\n",
        encoding="utf-8",
    )
    light = transport.team(4, vehicle=file, load_kg=0.5)
    with pytest.raises(
        transport.ScenarioError, match=r"weak\.toml: controller\.limits\.thrust_N: .*hover thrust"
    ):
        light.resized(6)
    with pytest.raises(
        transport.ScenarioError, match=r"^load_kg=4: controller\.limits\.thrust_N: "
    ):
        light.resized(6, load_kg=4.0)


def test_sizes_out_of_range_are_arguments() -> None:
    """Numbers of UAVs are refused as arguments of the call."""
    scenario = transport.Scenario("resilient")
    with pytest.raises(transport.ArgumentError, match="uavs: expected 2 to 256, got 1"):
        scenario.resized(1)
    with pytest.raises(transport.ArgumentError, match="group: expected at least 1 UAV per agent"):
        scenario.resized(4, group=0)


def test_whole_sections_are_values() -> None:
    """A section is given as one value, as for `--set`, by name or as an attribute."""
    scenario = transport.Scenario("resilient", {"radio": {"rate_mbps": 12.0}})
    assert scenario["radio.rate_mbps"] == 12.0
    scenario.links = {"delay_s": 0.2}
    assert (scenario["delay_s"], scenario["loss"]) == (0.2, 0.0)


WRONG: list[tuple[dict[str, Any], str]] = [
    (
        {"settings": {"links.delay_s": None}},
        "links.delay_s=None: expected a number in s, got None",
    ),
    ({"source": "resilent"}, "did you mean 'resilient'"),
    ({"source": "missing.toml"}, "no such file"),
    ({"settings": {"faults.event": [{1: 2}]}}, "faults.event.1.1: unknown key"),
    ({"settings": {"delay": 1}}, "did you mean 'delay_s'"),
    (
        {"settings": {"links.delay_s": 0.1}, "delay_s": 0.1},
        "delay_s: expected each key once, got links.delay_s twice",
    ),
    (
        {"horizn": 3},
        "horizn: expected a dotted key such as 'links.delay_s' or a short name; did you mean 'horizon'",
    ),
]


@pytest.mark.parametrize(("arguments", "text"), WRONG)
def test_wrong_arguments(arguments: dict[str, Any], text: str) -> None:
    """An argument of the wrong kind is refused with its name, expected and got, on one line."""
    with pytest.raises(transport.TransportError) as caught:
        transport.Scenario(**{"source": "paper", **arguments})
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_are_the_callers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A relative file in a Python setting is in the current folder, not beside the ready scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d.csv").write_text("0.1 0.2", encoding="utf-8")
    (tmp_path / "way.csv").write_text("t_s,x_m,y_m,z_m\n0,0,0,0\n2,1,0,0\n", encoding="utf-8")
    scenario = transport.Scenario("resilient", phases=[{"name": "way", "file": "way.csv"}])
    scenario.set({"links.samples_s": "d.csv", "links.distribution": "empirical"})
    assert scenario.links.samples_s == (0.1, 0.2)
    assert scenario.maneuver.phase[0].displacement_m == (1.0, 0.0, 0.0)
