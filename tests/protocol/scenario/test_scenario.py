"""Reading scenarios: files, defaults, settings, writing back, digest, and the objects built from them."""

import copy
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from tests.support.runs import PAPER, SCENARIOS, setup
from transport.protocol.scenario.checks.relations import after_the_end
from transport.protocol.scenario.scenario_file import (
    ScenarioError,
    find_scenario,
    read_scenario,
    validate,
)
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.model_objects import maneuver_of
from transport.protocol.scenario.setup.run_setup import Setup, rules_of

# A value of the same type that differs, for what cannot simply be counted up.
OTHER_WORDS = {
    "reference": "flat",
    "profile": "step",
    "engine": "mujoco",
    "kind": "land",
    "suspension": "cables",
    "penalised_input": "absolute",
    "solver": "clarabel",
    "share": "on_change",
    "silence": "law",
    "targets": "confirmed",
    "received_plans": "held",
    "received_states": "as_received",
    "discretisation": "euler",
    "linearisation": "along",
    "fail_safe": "follow",
    "estimator": "kalman",
    "sensors": "vehicle",
    "inputs": "rates",
    "inner_loop": "betaflight",
    "controller": "pid:PID",
    "prediction": "closed_loop",
    "terminal": "riccati",
    "actuation": "immediate",
    "mode": "realtime",
    "on_agent_loss": "continue",
    "on_collision": "end",
    "on_coordinator_loss": "continue",
    "autopilot": "px4",
    "at_end": "land",
    "on_overrun": "hold",
    "between": "agent4",
    "from": "agent3",
    "to": "agent4",
    "samples": [0.3],
    "trace": [[0.0, 0.1], [0.05, -1.0]],
    "do": "continue",
    "target": "agent4",
    "name": "other",
    "host": "localhost",
    "distribution": "normal",
    "expression": "r0[2] <= 1",
}
UNCHANGEABLE = {("schema",)}  # one choice

LINKS = (
    "links={delay_s=0.1,jitter_s=0.05,loss=0.1,gilbert_elliott={enter=0.1,leave=0.2},duplicate=0.1,reorder=0.1,"
    "reorder_s=0.2,rate_hz=10.0,measurement={delay_s=0.1},actuation={loss=0.2},"
    "override=[{from='agent1',to='plant',loss=0.3},{from='agent2'}],"
    "partition=[{between=['agent1','plant'],start_s=1.0,end_s=2.0}],"
    "change=[{at_s=1.0,to='agent2',loss=0.0},{at_s=2.0,from='plant',delay_s=0.0,gilbert_elliott={enter=0.0,leave=1.0}}]}"
)
FAULTS = (
    "faults.event=[{at_s=1.0,do='kill',target='agent1'},{at_s=2.0,do='restart',target='agent1'},"
    "{at_s=3.0,do='stop',target='plant'}]"
)

# Two that all know, and one that only sight tells.
OBSTACLES = (
    "obstacle=[{kind='cylinder',at_m=[90,0,0],radius_m=1,margin_m=1},"
    "{kind='sphere',at_m=[0,90,0],radius_m=1,margin_m=1,seen_within_m=2},"
    "{kind='box',at_m=[0,-90,0],size_m=[1,1,1],margin_m=1}]"
)

EVERYTHING = (
    "network.base_port=7000",
    "controller.constraint=[{expression='thrust1 <= 40'}]",
    "controller.cost=[{expression='v0[0]',weight=0.5}]",
    "agents.owned=[[1, 2], [4, 3]]",
    "clock.actuation=next_tick",
    "clock.overrun_limit_s=0.5",
    LINKS,
    FAULTS,
)


def leaves(node: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of all plain values in a tree, lists of numbers entry by entry."""
    if isinstance(node, dict | list):
        for key, child in node.items() if isinstance(node, dict) else enumerate(node):
            yield from leaves(child, (*path, key))
    else:
        yield path


def changed(tree: dict[str, Any], path: tuple[str | int, ...]) -> dict[str, Any]:
    """The tree with one plain value replaced by another valid one."""
    tree = copy.deepcopy(tree)
    node: Any = tree
    for key in path[:-1]:
        node = node[key]
    value = node[path[-1]]
    if isinstance(value, bool):
        node[path[-1]] = not value
    elif path == ("plant", "kind"):
        node[path[-1]] = "vehicles"
    elif isinstance(value, str):
        node[path[-1]] = OTHER_WORDS[next(key for key in reversed(path) if isinstance(key, str))]
    elif path[-1] in ("loss", "duplicate", "reorder", "enter", "leave"):
        node[path[-1]] = 0.5
    elif path[-1] in (
        "relaxation",
        "step_s",
        "failed_share",
        "battery",
        "battery_land",
        "hover_share",
        "stale_s",
        "clock_offset_s",
    ):
        node[path[-1]] = value / 2
    else:
        node[path[-1]] = value + 1
    return tree


def minimal() -> dict[str, Any]:
    """The paper's system and maneuver, everything else left out."""
    tree = tomllib.loads(PAPER.read_text(encoding="utf-8"))
    return {
        "name": tree["name"],
        "system": {"payload": tree["system"]["payload"], "uav": tree["system"]["uav"]},
        "maneuver": {"phase": tree["maneuver"]["phase"]},
    }


@pytest.mark.parametrize(
    ("name", "owned"), [("paper", ((0,), (1,), (2,), (3,))), ("centralized", ((0, 1, 2, 3),))]
)
def test_ready_scenarios(name: str, owned: tuple[tuple[int, ...], ...]) -> None:
    """The scenarios that come with the project load and build.

    They differ only in name and ownership.
    """
    path = SCENARIOS / f"{name}.toml"
    scenario = read_scenario(path)
    built = Setup.of(scenario, str(path))
    assert scenario.name == name
    assert built.owned == owned
    assert built.agents == tuple(range(1, len(owned) + 1))
    assert (built.ticks, built.period_ns) == (500, 50_000_000)
    paper = read_scenario(PAPER).tree()
    assert scenario.tree() | {"name": "paper", "agents": paper["agents"]} == paper


def test_defaults() -> None:
    """Left out, every key has the value paper.toml spells out, but no separation and plans shifted by their age."""
    tree = validate(minimal(), "minimal").tree()
    expected = read_scenario(PAPER).tree()
    expected["controller"]["received_plans"] = "by_age"
    del expected["controller"]["separation"]
    expected["agents"] = {"controller": "mpc", "failed_share": 0.05}
    assert tree == expected
    assert tree["seed"] == 0
    assert tree["clock"] == {
        "mode": "lockstep",
        "speed": 0.0,
        "barrier_timeout_s": 5.0,
        "join_timeout_s": 30.0,
        "on_agent_loss": "abort",
        "on_coordinator_loss": "end",
        "on_overrun": "continue",
        "overrun_limit": 0,
    }
    assert tree["plant"].pop("step_s") <= 0.01
    assert (tree["plant"]["max_attitude_deg"], tree["plant"]["max_error_m"]) == (80.0, 20.0)
    assert tree["faults"] == {"event": []}
    assert tree["network"] == {"host": "127.0.0.1", "insecure": False, "secret": True}


@pytest.mark.parametrize("settings", [(), EVERYTHING, ("controller.relaxation=auto",)])
def test_written_back(settings: tuple[str, ...], tmp_path: Path) -> None:
    """tree() written as TOML reads back as an equal scenario with an equal digest."""
    scenario = read_scenario(PAPER, settings)
    path = tmp_path / "scenario.toml"
    path.write_text(tomli_w.dumps(scenario.tree()), encoding="utf-8")
    again = read_scenario(path)
    assert again == scenario
    assert again.tree() == scenario.tree()
    assert again.digest() == scenario.digest()


def test_changes_are_written_back_as_given(tmp_path: Path) -> None:
    """A scripted change of links is written with the keys it was given and no others.

    A default would be a change.
    """
    path = tmp_path / "scenario.toml"
    path.write_text(tomli_w.dumps(read_scenario(PAPER, EVERYTHING).tree()), encoding="utf-8")
    assert tomllib.loads(path.read_text(encoding="utf-8"))["links"]["change"] == [
        {"at_s": 1.0, "to": "agent2", "loss": 0.0},
        {
            "at_s": 2.0,
            "from": "plant",
            "delay_s": 0.0,
            "gilbert_elliott": {"enter": 0.0, "leave": 1.0, "loss": 1.0},
        },
    ]
    once, again = setup(*EVERYTHING), Setup.of(read_scenario(path), str(path))
    for ends in (("agent1", "agent2"), ("plant", "agent1"), ("agent3", "plant")):
        for tick in (0, 19, 20, 39, 40):
            assert again.rules.link(*ends).impairments(tick) == once.rules.link(*ends).impairments(
                tick
            )


def test_the_end_of_a_silence_is_written_without_defaults() -> None:
    """A change back to the default of its key is kept where defaults are left out."""
    silence = "links.change=[{at_s=9.0,loss=1.0},{at_s=11.0,from='agent1',loss=0.0}]"
    scenario = read_scenario(PAPER, [silence])
    tree = scenario.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True)
    assert tree["links"]["change"] == [
        {"at_s": 9.0, "loss": 1.0},
        {"at_s": 11.0, "from": "agent1", "loss": 0.0},
    ]


@pytest.mark.parametrize(
    ("settings", "next_tick"),
    [
        ((), False),
        (("clock.actuation=immediate",), False),
        (("clock.actuation=next_tick",), True),
        (("clock.mode=realtime", "clock.speed=1"), True),
        (("clock.mode=realtime", "clock.speed=1", "clock.actuation=next_tick"), True),
    ],
)
def test_default_of_the_actuation(settings: tuple[str, ...], next_tick: bool) -> None:
    """Inputs act at once in lockstep, as in the paper, and at the next tick in real time, unless the scenario says."""
    assert read_scenario(PAPER, settings).clock.next_tick == next_tick


def test_digest_covers_every_field_but_the_network() -> None:
    """Any value changed anywhere changes the digest, except the network addresses, which may differ per host."""
    scenario = read_scenario(PAPER, EVERYTHING)
    tree, digest = scenario.tree(), scenario.digest()
    seen = {digest}
    for path in leaves(tree):
        if path in UNCHANGEABLE:
            continue
        other = Scenario.model_validate(changed(tree, path))
        if path[0] == "network":
            assert other.digest() == digest
        else:
            assert other.digest() not in seen, path
            seen.add(other.digest())
    assert len(seen) > 60  # the walk has really been through the tree


def test_digest_ignores_formatting(tmp_path: Path) -> None:
    """Comments, order, integers for floats and spelled-out defaults do not change the digest."""
    tree = minimal()
    spelled = read_scenario(
        PAPER, ["controller.separation={minimum_m=1}", "controller.received_plans=by_age"]
    ).tree()
    del spelled["controller"]["separation"]
    del spelled["agents"]["owned"]
    path = tmp_path / "other.toml"
    path.write_text(
        "# a comment\n" + tomli_w.dumps(dict(reversed(spelled.items()))), encoding="utf-8"
    )
    assert read_scenario(path, ["clock.speed=0"]).digest() == validate(tree, "minimal").digest()


@pytest.mark.parametrize(
    ("setting", "path", "value"),
    [
        ("controller.solver=clarabel", ("controller", "solver"), "clarabel"),
        ('controller.solver="clarabel"', ("controller", "solver"), "clarabel"),
        ("controller.solver='clarabel'", ("controller", "solver"), "clarabel"),
        ("controller.solver= clarabel ", ("controller", "solver"), "clarabel"),
        (" controller.horizon = 7 ", ("controller", "horizon"), 7),
        ("clock.speed=2", ("clock", "speed"), 2.0),
        ("clock.speed=2.5e-1", ("clock", "speed"), 0.25),
        ("controller.relaxation=auto", ("controller", "relaxation"), "auto"),
        (
            "controller.constraint=[{expression='thrust1<=40', soft=false}]",
            ("controller", "constraint", 0, "soft"),
            False,
        ),
        ("agents.owned=[[1,2],[3,4]]", ("agents", "owned"), [[1, 2], [3, 4]]),
        ("agents.owned.2=[2]", ("agents", "owned", 1), [2]),
        ("system.uav.2.mass_kg=1.6", ("system", "uav", 1, "mass_kg"), 1.6),
        (
            "controller.weights.moments.3=0.5",
            ("controller", "weights", "moments"),
            [0.01, 0.01, 0.5],
        ),
        ("maneuver.phase.5.name=wait", ("maneuver", "phase", 4, "name"), "wait"),
        ("name=run-2", ("name",), "run-2"),
        ("network.host=plant.local", ("network", "host"), "plant.local"),
        ("network.keys=a=b", ("network", "keys"), "a=b"),
    ],
)
def test_settings(setting: str, path: tuple[str | int, ...], value: Any) -> None:
    """A setting's value is TOML or, if it is none, the bare words; list entries are counted from 1."""
    node: Any = read_scenario(PAPER, [setting]).tree()
    for key in path:
        node = node[key]
    assert node == value
    assert type(node) is type(value)


def test_data_sheet_of_the_sensors() -> None:
    """Noise, bias and age of positions, velocities, attitudes, rates and specific forces, in this order."""
    keys = "position_m", "velocity_mps", "attitude_rad", "rate_rads", "specific_force_mps2"
    delays = "position_s", "velocity_s", "attitude_s", "rate_s", "specific_force_s"
    noise = [f"plant.noise.{key}=0.0{number}" for number, key in enumerate(keys, start=1)]
    bias = [f"plant.noise.bias.{key}=0.00{number}" for number, key in enumerate(keys, start=1)]
    # Three periods of 0.05 s are 0.15 s but for rounding: 0.15 / 0.05 < 3.
    ages_s = zip(delays, (0.15, 0.3, 0.0, 0.05, 0.1), strict=True)
    delay = [f"plant.noise.delay.{key}={age_s}" for key, age_s in ages_s]
    vehicle = "plant.sensors=vehicle", "controller.estimator=kalman"
    law = "controller.prediction=closed_loop", "controller.received_plans=by_age"
    sheet = setup(*vehicle, *law, *noise, *bias, *delay).sensors
    assert sheet.vehicle
    assert sheet.noise.tolist() == [0.01, 0.02, 0.03, 0.04, 0.05]
    assert sheet.bias.tolist() == [0.001, 0.002, 0.003, 0.004, 0.005]
    assert sheet.ages == (3, 6, 0, 1, 2)


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("paper", (), {"delay": 0, "relayed": True, "by_vehicles": False, "confirms": False}),
        ("paper", ("clock.actuation=next_tick",), {"delay": 1, "relayed": True}),
        ("paper", ("clock.mode=realtime",), {"delay": 1, "relayed": False}),
        ("paper", ("controller.negotiation_iterations=3",), {"negotiation_iterations": 3}),
        ("paper", ("agents.owned=[[1,2],[3,4]]",), {"uavs": 4, "owned": {1: (1, 2), 2: (3, 4)}}),
        ("flight", (), {"by_vehicles": True, "vehicle_sensors": True}),
        ("resilient", ("controller.targets=confirmed",), {"confirms": True, "sights": 0}),
        ("resilient", (OBSTACLES,), {"sights": 1}),
    ],
)
def test_rules_follow_from_the_keys(
    name: str, settings: tuple[str, ...], expected: dict[str, Any]
) -> None:
    """The shape of a run, by which each process checks messages."""
    shape = rules_of(read_scenario(find_scenario(name), settings)).shape
    assert {field: getattr(shape, field) for field in expected} == expected


def test_obstacles_that_only_sight_tells_are_not_known() -> None:
    """Controllers know the others, in the order of the file; the plant knows all."""
    run = Setup.of(read_scenario(find_scenario("resilient"), [OBSTACLES]), "resilient")
    assert [known.name for known in run.known_obstacles] == ["cylinder", "box"]
    assert [one.name for one in run.obstacles] == ["cylinder", "sphere", "box"]


def test_automatic_relaxation() -> None:
    """Relaxation "auto" is 1/M for M agents: the descent guarantee of cooperative distributed MPC."""
    assert setup("controller.relaxation=auto").settings.relaxation == 0.25
    assert (
        setup("controller.relaxation=auto", "agents.owned=[[1,2],[3,4]]").settings.relaxation == 0.5
    )


@pytest.mark.parametrize(
    "settings",
    [
        ["clock.mode=realtime"],
        ["clock={mode='realtime'}"],
        ["clock.mode=realtime", "clock.speed=1"],
    ],
)
def test_real_time_alone_has_the_speed_of_real_time(settings: list[str]) -> None:
    """A change to real time alone runs at speed 1: the scenario's 0 is that of lockstep."""
    assert read_scenario(PAPER).clock.speed == 0.0
    clock = read_scenario(PAPER, settings).clock
    assert (clock.mode, clock.speed) == ("realtime", 1.0)


def test_a_spline_passes_different_way_points() -> None:
    """Way points at the same place have no spline at a speed; at times the payload waits there."""
    phase = "maneuver.phase=[{name='s',kind='spline',points_m=%s,%s}]"
    for points in ("[[1,0,0],[1,0,0]]", "[[0,0,0],[1,0,0]]"):
        for duration in ("speed_mps=1.0", "duration_s=9.0", "speed_mps=1,displacement_m=[1,0,0]"):
            with pytest.raises(ScenarioError, match="points_m: expected each way point away from"):
                read_scenario(PAPER, [phase % (points, duration)])
    timed = read_scenario(PAPER, [phase % ("[[1,0,0],[1,0,0],[2,0,0]]", "times_s=[4,5,9]")])
    assert timed.maneuver.phase[0].duration_s == 9.0


@pytest.mark.parametrize(
    ("shape", "least_mps"),
    [
        ("kind='circle',size_m=[2,1,0.5]", 1.499),
        ("kind='eight',size_m=[2,1,0],laps=2", 1.499),
        ("kind='spline',points_m=[[5,0,0],[5,5,-1],[10,0,0]]", 1.2),  # fastest in a ramp
    ],
)
def test_a_curve_has_the_largest_speed_given(shape: str, least_mps: float) -> None:
    """The duration follows from `speed_mps`, with the ramps at both ends."""
    phase = f"maneuver.phase=[{{name='s',{shape},speed_mps=1.5,ramp_s=2.0}}]"
    maneuver = maneuver_of(read_scenario(PAPER, [phase]))
    instants_s = np.linspace(0.0, maneuver.duration_s, 5_000)
    speeds_mps = np.linalg.norm(maneuver.jets(instants_s)[1], axis=1)
    assert least_mps < speeds_mps.max() < 1.501


def test_events_after_the_end_are_told() -> None:
    """A time in milliseconds is a valid one at which nothing happens any more."""
    scenario = read_scenario(
        find_scenario("paper"),
        [
            "faults.event=[{at_s=8000.0,do='kill',target='agent3'},"
            "{at_s=24.96,do='kill',target='agent2'},{at_s=24.95,do='kill',target='agent1'}]",
            "links.change=[{at_s=1.0,loss=1.0},{at_s=2000.0,loss=0.0}]",
            "links.partition=[{between=['agent1'],start_s=25.0,end_s=26.0}]",
        ],
    )
    told = list(after_the_end(scenario))
    assert [text.split(":")[0] for text in told] == [
        "faults.event.1.at_s",
        "faults.event.2.at_s",
        "links.change.2.at_s",
        "links.partition.1.start_s",
    ]
    when = "8000 s is after the last tick, 24.95 s, of the run of 25 s, so it does not happen"
    assert told[0].endswith(when)
