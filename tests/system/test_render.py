"""Inventories and the folders rendered from them."""

import json
import shlex
import shutil
import subprocess
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support.keyrings import keyring
from tests.support.results import here
from tests.support.runs import setup
from transport.cli.main import app
from transport.deploy.folders import render
from transport.deploy.inventory import DeployError, Inventory, read_inventory
from transport.deploy.placements import placements
from transport.deploy.units import command
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import endpoints_of, process_names
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.wire.key_expressions import ROUTER

RUN = setup()
PROCESSES = process_names(RUN.scenario)
MESH = """
run = "two"
[[host]]
name = "ground"
address = "192.0.2.10"
runs = ["coordinator", "plant", "agent1", "agent2", "recorder"]
cpus = { plant = [0, 1] }
priority = 10
[[host]]
name = "remote"
address = "2001:db8::7"
listen = "::"
runs = ["agent3", "agent4"]
"""
STAR = MESH.replace('"recorder"]', '"recorder", "router"]')
SIDES = STAR.replace('"agent4"]', '"agent4", "router"]')
# The processes of `ground` use the router of the other side.
CROSSED = SIDES.replace('name = "ground"', 'name = "ground"\nrouter = "remote"')


def inventory(text: str, folder: Path) -> Inventory:
    """Return an inventory read from a file."""
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "hosts.toml").write_text(text)
    return read_inventory(folder / "hosts.toml", PROCESSES)


def places(text: str, folder: Path) -> dict[str, tuple[str, list[str], list[str]]]:
    """Return mode, listen and connect endpoints, by host and process."""
    return {
        f"{placement.host.name}/{placement.process}": (
            placement.endpoints.mode,
            list(placement.endpoints.listen),
            list(placement.endpoints.connect),
        )
        for placement in placements(inventory(text, folder), PROCESSES, "tls")
    }


def network(folder: Path) -> dict[str, Any]:
    """Return the section `network` in the scenario of a host's folder."""
    section: dict[str, Any] = tomllib.loads((folder / "scenario.toml").read_text())["network"]
    return section


def command_line(folder: Path, process: str) -> list[str]:
    """Return the command of a unit in a host's folder, in words."""
    unit = (folder / "systemd" / f"transport-{process}.service").read_text()
    (line,) = [line for line in unit.splitlines() if line.startswith("ExecStart=")]
    return shlex.split(line.removeprefix("ExecStart="))


def values(words: list[str], option: str) -> list[str]:
    """Return the values of an option in a command line."""
    return [value for name, value in pairwise(words) if name == option]


def test_a_mesh(tmp_path: Path) -> None:
    """A process listens on the port of its place in the list and connects to all before it, the recorder to all."""
    found = places(MESH, tmp_path)
    assert found["ground/coordinator"] == ("peer", ["tls/192.0.2.10:7447"], [])
    called = [f"tls/192.0.2.10:{port}" for port in (7447, 7448, 7449, 7450)]
    assert found["remote/agent3"] == ("peer", ["tls/[::]:7451"], called)
    assert found["remote/agent4"] == (
        "peer",
        ["tls/[::]:7452"],
        [*called, "tls/[2001:db8::7]:7451"],
    )
    every = [*called, "tls/[2001:db8::7]:7451", "tls/[2001:db8::7]:7452"]
    assert found["ground/recorder"] == ("peer", [], every)


def test_routers(tmp_path: Path) -> None:
    """Processes are clients of the router of their side; a second router connects to the first."""
    at, there = "tls/192.0.2.10:7447", "tls/[2001:db8::7]:7447"
    star = places(STAR, tmp_path)
    assert star.pop("ground/router") == ("router", [at], [])
    assert set(map(str, star.values())) == {str(("client", [], [at]))}
    sides = places(SIDES, tmp_path)
    assert sides["remote/router"] == ("router", ["tls/[::]:7447"], [at])
    assert sides["remote/agent3"] == ("client", [], [there])
    assert sides["ground/agent1"] == ("client", [], [at])
    crossed = places(CROSSED, tmp_path)
    assert crossed["ground/agent1"] == ("client", [], [there])
    assert crossed["ground/recorder"] == ("client", [], [there])
    assert crossed["remote/agent3"] == ("client", [], [there])


@pytest.mark.parametrize(
    "text", [MESH, STAR, SIDES, CROSSED], ids=["mesh", "star", "sides", "crossed"]
)
def test_processes_take_the_endpoints_of_their_placement(text: str, tmp_path: Path) -> None:
    """Unit, scenario and keys of a host's folder give each process the endpoints of its placement."""
    ready = inventory(text, tmp_path)
    render(RUN, ready, keyring("one"), tmp_path / "out", in_place=True)
    for placement in placements(ready, PROCESSES, "tls"):
        words = command_line(tmp_path / "out" / placement.host.name, placement.process)
        (scenario,) = values(words, "--scenario")
        listen, connect = values(words, "--listen"), values(words, "--connect")
        if placement.process == ROUTER:
            taken = Endpoints(listen=listen, connect=connect, mode="router")
        else:
            taken = endpoints_of(
                placement.process, read_scenario(Path(scenario)), listen or None, connect or None
            )
        assert replace(taken, security=None) == placement.endpoints, placement.process


@pytest.mark.parametrize(
    ("text", "ground", "remote"),
    [
        (MESH, None, None),
        (STAR, "tls/192.0.2.10:7447", "tls/192.0.2.10:7447"),
        (SIDES, "tls/192.0.2.10:7447", "tls/[2001:db8::7]:7447"),
        (CROSSED, "tls/[2001:db8::7]:7447", "tls/[2001:db8::7]:7447"),
        (f"insecure = true\n{MESH}", None, None),
        (f"insecure = true\n{STAR}", "tcp/192.0.2.10:7447", "tcp/192.0.2.10:7447"),
    ],
    ids=["mesh", "star", "sides", "crossed", "open mesh", "open star"],
)
def test_the_network_of_each_host(
    text: str, ground: str | None, remote: str | None, tmp_path: Path
) -> None:
    """The scenario of a host names address and port to listen on, its keys, and the router of its processes.

    Clients connect by nothing else.
    """
    ready = inventory(text, tmp_path)
    keys = None if ready.insecure else keyring("one")
    security = {"insecure": True} if ready.insecure else {"keys": "/etc/transport/keys"}
    folders = render(RUN, ready, keys, tmp_path / "out")
    addresses = {"192.0.2.10": ground, "::": remote}
    for folder, (address, router) in zip(folders, addresses.items(), strict=True):
        found = network(folder)
        assert found.pop("router", None) == router
        assert found == {"host": address, "base_port": 7447, **security}


def test_the_coordinator_waits_for_a_recorder_of_the_inventory(tmp_path: Path) -> None:
    """The coordinator is to wait for the recorder if a host runs one: else it would wait in vain."""
    without = MESH.replace(', "recorder"]', "]")
    elsewhere = without.replace('"agent4"]', '"agent4", "recorder"]')
    for number, (text, observers) in enumerate(
        ((without, []), (MESH, ["recorder"]), (elsewhere, ["recorder"]))
    ):
        ready = inventory(text, tmp_path)
        ground, _ = render(RUN, ready, keyring("one"), tmp_path / str(number))
        assert values(command_line(ground, "coordinator"), "--observer") == observers


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("", "x = "), "not valid TOML"),
        (('"agent4"]', "]"), "host: expected one host that runs agent4, got 0"),
        (('"agent4"]', '"agent4", "agent2"]'), "host: expected one host that runs agent2, got 2"),
        (('"agent4"]', '"agent4", "agent4"]'), "host.2.runs: expected each process once, got"),
        (('"agent4"]', '"agent44"]'), "host.2.runs: expected one of coordinator, plant"),
        (('"agent4"]', '"agnet4"]'), "got 'agnet4'"),
        (("cpus = { plant", "cpus = { agent3"), "host.1.cpus: expected one of coordinator, plant"),
        (('"remote"', '"ground"'), "host.2.name: expected each host once, got 'ground' again"),
        (("priority = 10", "priority = 99"), "host.1.priority: "),
        (("priority = 10", "prio = 9"), "host.1.prio: "),
        (
            ("priority = 10", 'router = "remote"'),
            "host.1.router: expected a host that runs a router, one of []",
        ),
        (('"192.0.2.10"', '"a b"'), "host.1.address: "),
    ],
)
def test_bad_inventories(change: tuple[str, str], expected: str, tmp_path: Path) -> None:
    """The error has file, field, expected and got."""
    old, new = change
    text = MESH.replace(old, new, 1) if old else new
    with pytest.raises(DeployError) as caught:
        inventory(text, tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}/hosts.toml: ")
    assert expected in str(caught.value)


def test_each_host_gets_its_own(tmp_path: Path) -> None:
    """A host gets only its own units and keys, and the common scenario.

    The digest does not depend on the host.
    """
    ground, remote = render(RUN, inventory(MESH, tmp_path), keyring("one"), tmp_path / "out")
    keys = {file.name for file in (remote / "keys").iterdir()}
    assert keys == {"ca.pem", "agent3.pem", "agent3.key", "agent4.pem", "agent4.key"}
    assert {"operator.key", "watcher.key"} < {file.name for file in (ground / "keys").iterdir()}
    assert not [file for file in (tmp_path / "out").rglob("*") if file.name == "ca.key"]
    units = {file.name for file in (remote / "systemd").iterdir()}
    assert units == {"transport-agent3.service", "transport-agent4.service"}
    for folder in (ground, remote):
        scenario = read_scenario(folder / "scenario.toml")
        assert scenario.digest() == RUN.scenario.digest()
        subprocess.run(["sh", "-n", folder / "install.sh"], check=True)
    coordinator = (ground / "systemd" / "transport-coordinator.service").read_text()
    assert (
        "After=network-online.target transport-plant.service transport-agent1.service"
        in coordinator
    )
    assert "\nRestart=no\n" in coordinator
    assert "--observer recorder" in coordinator
    assert "CPUSchedulingPriority=10\n" in coordinator
    assert "CPUAffinity=0 1\n" in (ground / "systemd" / "transport-plant.service").read_text()
    assert "\nRestart=on-failure\n" in (remote / "systemd" / "transport-agent3.service").read_text()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze (systemd)")
def test_units_are_units(tmp_path: Path) -> None:
    """systemd accepts the units and rates their hardening at least OK (exposure below 3 of 10)."""
    folder, _ = render(RUN, inventory(STAR, tmp_path), keyring("one"), tmp_path / "out")
    units = sorted((folder / "systemd").iterdir())
    assert len(units) == 6
    for unit in units:
        unit.write_text(unit.read_text().replace("/opt/transport/bin/transport", "/bin/true"))
    checked = subprocess.run(
        ["systemd-analyze", "verify", *units], capture_output=True, text=True, check=False
    )
    assert (checked.returncode, checked.stderr) == (0, "")
    command_line = [
        "systemd-analyze",
        "security",
        "--offline=true",
        "--threshold=30",
        str(units[0]),
    ]
    assert subprocess.run(command_line, capture_output=True, check=False).returncode == 0


def test_refused_renderings(tmp_path: Path) -> None:
    """Rendering needs keys or `insecure`, a new folder, and every key."""
    mesh = inventory(MESH, tmp_path)
    with pytest.raises(DeployError, match="expected a folder of keys, or insecure = true"):
        render(RUN, mesh, None, tmp_path / "out")
    with pytest.raises(DeployError, match=r"expected the file .*ca\.pem"):
        render(RUN, inventory(STAR, tmp_path), tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    open_to_all = inventory(f"insecure = true\n{MESH}", tmp_path)
    folders = render(RUN, open_to_all, None, tmp_path / "out")
    assert read_scenario(folders[0] / "scenario.toml").network.insecure
    with pytest.raises(DeployError, match="expected a folder that does not exist yet"):
        render(RUN, open_to_all, None, tmp_path / "out")


def test_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The two commands of docs/deploy.md make keys and folders, and refuse a missing inventory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hosts.toml").write_text(MESH)
    made = here("deploy", "keys", "--hosts", "hosts.toml", "--out", "keys")
    assert made.exit_code == 0, made.stderr
    rendered = here("deploy", "render", "--hosts", "hosts.toml", "--keys", "keys", "--out", "out")
    assert rendered.exit_code == 0, rendered.stderr
    assert (tmp_path / "out" / "remote" / "install.sh").exists()
    checked = subprocess.run(
        [
            "openssl",
            "verify",
            "-verify_ip",
            "192.0.2.10",
            "-CAfile",
            "keys/ca.pem",
            "keys/agent1.pem",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stderr
    again = here("deploy", "render", "--hosts", "none.toml", "--keys", "keys", "--out", "x")
    assert (again.exit_code, again.stderr) == (2, "transport: none.toml: no such file\n")


def test_a_large_run_is_rendered_on_purpose(tmp_path: Path) -> None:
    """A run beyond the limits is refused without --allow-large.

    With it, its processes accept the run as well.
    """
    (tmp_path / "hosts.toml").write_text(f"insecure = true\n{MESH}")
    arguments = [
        "deploy",
        "render",
        "--hosts",
        str(tmp_path / "hosts.toml"),
        "--out",
        str(tmp_path / "out"),
    ]
    arguments += ["--set", "plant.step_s=1e-6"]
    refused = CliRunner().invoke(app, arguments)
    assert (refused.exit_code, refused.stderr.count("--allow-large admits more")) == (3, 1)
    assert CliRunner().invoke(app, [*arguments, "--allow-large"]).exit_code == 0
    units = [file.read_text() for file in (tmp_path / "out").rglob("*.service")]
    assert len(units) == 7
    assert all(" --allow-large " in unit for unit in units)


def test_compose_equals_units(tmp_path: Path) -> None:
    """The commands of compose.yaml equal those of the rendered units."""
    folder = Path(__file__).resolve().parents[2] / "deploy"
    ready = read_inventory(folder / "hosts-compose.toml", PROCESSES)
    services = (folder / "compose.yaml").read_text()
    for placement in placements(ready, PROCESSES, "tls"):
        _, *arguments = command(placement, ready)
        arguments += ["--out", "/record/run"] if placement.process == "recorder" else []
        assert f"    command: {json.dumps(arguments)}\n" in services, placement.process
        assert f"/{placement.host.name}:/etc/transport:ro" in services


def test_the_example_inventory(tmp_path: Path) -> None:
    """deploy/hosts.toml describes a deployment of the ready scenarios."""
    example = read_inventory(
        Path(__file__).resolve().parents[2] / "deploy" / "hosts.toml", PROCESSES
    )
    assert len(render(RUN, example, keyring("one"), tmp_path / "out")) == 2
