"""Commands of single processes: their place in a run, what they wait for, and what they refuse."""

import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

from transport.cli.hosts import processes
from transport.cli.hosts.processes import ProcessOptions
from transport.cli.main import app
from transport.protocol.scenario.sections.vehicles_section import DEFAULT_VEHICLE_PORT

TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
CODE = 7  # with which a process ends here


def ask(*words: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, words)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The nodes that are run: name, incarnation, and the other processes."""
    nodes: list[Any] = []

    def run_node(node: Any, place: Any, _rules: Any, others: Sequence[str], **given: Any) -> int:
        assert given.get("linger_for", others) == others
        nodes.append((node.name, place.incarnation, sorted(others)))
        return CODE

    monkeypatch.setattr(processes, "run_node", run_node)
    monkeypatch.setattr(processes, "needs_compilation", lambda *_: False)
    for node in ("transport.agent.node.AgentNode", "transport.plant.node.PlantNode"):
        monkeypatch.setattr(f"{node}.warm_up", lambda _: None)
    return nodes


def test_a_place_is_that_of_the_scenario_or_of_the_options() -> None:
    """By default a start has the time as its number, ms."""
    own = ProcessOptions(settings=["clock.join_timeout_s=7.0"]).place("agent1")
    assert (own.run, own.join_timeout_s) == ("paper", 7.0)
    assert own.incarnation == pytest.approx(1e3 * time.time(), abs=1e5)
    given = ProcessOptions(run="r2", incarnation=0, join_timeout=1e6).place("agent1")
    assert (given.run, given.incarnation, given.join_timeout_s) == ("r2", 0, 1e6)
    assert ProcessOptions(join_timeout=0.0).place("agent1").join_timeout_s == 0.0


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"run": "a/b"}, "--run: "),
        ({"join_timeout": 1.1e6}, "--join-timeout: expected 0 to 1e+06 s, got 1.1e+06"),
        ({"listen": ["tcp/"]}, "--listen: expected an endpoint such as tcp/127.0.0.1:7447, got 'tcp/'"),
        ({"listen": ["tcp/a b"]}, "--listen: "),
        ({"connect": ["tcp/a:1", "7447"]}, "--connect: "),
    ],
)  # fmt: skip
def test_a_place_is_refused(
    given: dict[str, Any], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the option that is to blame."""
    with pytest.raises(typer.Exit) as refused:
        ProcessOptions(**given).place("agent1")
    assert refused.value.exit_code == 2
    assert capsys.readouterr().err.startswith(f"transport: {text}")


@pytest.mark.parametrize(
    ("words", "name", "observers"),
    [
        (["agent", "--id", "4"], "agent4", []),
        (["plant"], "plant", []),
        (["coordinator"], "coordinator", []),
        (["coordinator", "--observer", "recorder"], "coordinator", ["recorder"]),
    ],
)
def test_a_process_waits_for_all_others(
    words: list[str], name: str, observers: list[str], started: list[Any]
) -> None:
    """And for observers that are named; its exit code is that of the command."""
    assert ask(*words, "--incarnation", "3").exit_code == CODE
    others = sorted([*(other for other in TEAM if other != name), *observers])
    assert started == [(name, 3, others)]


FLIGHT = ("--scenario", "flight", "--set", "plant.kind=vehicles")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["agent", "--id", "5"], "--id: expected an agent from 1 to 4 of scenario paper, got 5"),
        (["plant", *FLIGHT], "plant: expected a scenario with plant.kind = 'simulated', got 'vehicles'"),
        (
            ["vehicle", "--uav", "5", "--link", "udp:127.0.0.1:1", *FLIGHT],
            "--uav: expected a UAV from 1 to 4 of scenario flight, got 5",
        ),
    ],
)  # fmt: skip
def test_a_process_that_a_run_has_not_is_refused(
    words: list[str], text: str, started: list[Any]
) -> None:
    """In one line; nothing is started."""
    refused = ask(*words)
    assert (refused.exit_code, refused.stderr) == (2, f"transport: {text}\n")
    assert started == []


@pytest.mark.parametrize("check", [True, False])
def test_a_vehicle_opens_its_links(
    check: bool, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is checked, or run; the exit code is that of the check."""
    opened: list[Any] = []

    def open_autopilot(_section: Any, _limits: Any, uav: int, links: Any) -> Any:
        opened.append((uav, links.link, links.autopilot, links.pose, links.key))
        return SimpleNamespace(close=lambda: opened.append("closed"))

    def node(_run: Any, uav: int, _driver: Any, conduct: Any, incarnation: int, _: int) -> Any:
        opened.append((conduct.stands, incarnation))
        return SimpleNamespace(name=f"vehicle{uav}", warm_up=lambda: None)

    opening = "transport.vehicle.link_opening_and_check"
    monkeypatch.setattr(f"{opening}.open_autopilot", open_autopilot)
    monkeypatch.setattr(f"{opening}.check_autopilot", lambda *_: 9)
    monkeypatch.setattr("transport.vehicle.node.VehicleNode", node)
    links = ("--link", "tcp:a:1", "--autopilot", "betaflight", "--pose", "udp:b:2", "--key", "k")
    more = ("--check",) if check else ("--stands", "--incarnation", "3")
    assert ask("vehicle", "--uav", "4", *links, *more, *FLIGHT).exit_code == (9 if check else CODE)
    assert opened[0] == (4, "tcp:a:1", "betaflight", "udp:b:2", Path("k"))
    assert opened[-1] == "closed"
    assert opened[1:-1] == ([] if check else [(True, 3)])
    assert [name for name, *_ in started] == ([] if check else ["vehicle4"])


@pytest.mark.parametrize(
    ("autopilot", "given", "expected"),
    [
        (None, 9, "plant"),
        ("betaflight", 9, ("Betaflights", 9)),
        ("px4", 9, ("Autopilots", 9)),
        ("px4", None, ("Autopilots", DEFAULT_VEHICLE_PORT)),
    ],
)
def test_actuators_are_simulated_or_those_of_autopilots(
    autopilot: str | None, given: int | None, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which are found from the port of the scenario on, or from the usual one."""
    from transport.plant.autopilot import autopilot_processes, betaflight_over_msp, node

    for module, name in ((betaflight_over_msp, "Betaflights"), (autopilot_processes, "Autopilots")):
        monkeypatch.setattr(module, name, lambda _run, port, name=name: (name, port))
    monkeypatch.setattr(node, "PlayedPlant", lambda _run, bank, *_: bank)
    monkeypatch.setattr("transport.plant.node.PlantNode", lambda *_: "plant")
    monkeypatch.setattr("transport.flight.roles.plant_run", lambda _: None)
    network = SimpleNamespace(vehicle_port=given)
    scenario = SimpleNamespace(plant=SimpleNamespace(autopilot=autopilot), network=network)
    setup: Any = SimpleNamespace(scenario=scenario)
    assert processes._plant_node(setup, 0) == expected


@pytest.mark.parametrize("exit_code", [0, 6])
def test_a_recorded_run_is_reported(
    exit_code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the folder that is given; its exit code and reason are those of the run."""
    reported: list[Path] = []

    def observe(_setup: Any, _place: Any, folder: Path, _console: Any) -> Any:
        return SimpleNamespace(folder=folder, exit_code=exit_code, reason="far away")

    monkeypatch.setattr("transport.flight.run_execution.observe", observe)
    monkeypatch.setattr(
        "transport.cli.commands.plot.report", lambda folder, *_, **__: reported.append(folder)
    )
    ended = ask("record", "--out", str(tmp_path / "run"))
    assert ended.exit_code == exit_code
    assert ended.stderr == ("transport: far away\n" if exit_code else "")
    assert reported == [tmp_path / "run"]


@pytest.mark.parametrize("needed", [True, False])
def test_a_model_is_compiled_before_its_setup_is_used(
    needed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The setup is read anew then: it takes the functions that are compiled."""
    compiled: list[str] = []
    monkeypatch.setattr(processes, "needs_compilation", lambda *_: needed)
    monkeypatch.setattr(
        "transport.flight.progress.compile_models",
        lambda scenarios, _: compiled.extend(one.name for one in scenarios),
    )
    options = ProcessOptions()
    before = options.setup()
    assert (options.compiled_setup() is before) is not needed
    assert compiled == ["paper"] * needed
