"""Whole runs with keys: under attack, through routers, and what a process tells of itself meanwhile."""

import json
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from deploy.keys import make_passwords
from protocol.network.process import process_names
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.keys import Keys
from tests.support import attack
from tests.support.commands import (
    PATIENCE_S,
    command,
    free_base,
    is_flying,
    settings,
    start,
    transport,
    wait_for,
)
from tests.support.keyrings import NAMES, keyring
from tests.support.logs import flown
from tests.system.test_intruder import table
from transport.cli.metrics import process_endpoints
from transport.monitor.exporter import Exporter
from transport.report.report import write_report

# Paced, so that there is time for attacks; 6 s.
FLIGHT = (
    "maneuver.phase=[{name='climb',duration_s=6.0,displacement_m=[0.0,0.0,-1.0]}]",
    "controller.horizon=5",
    "clock.speed=1.0",
)
# As fast as it goes.
BRIEF = ("maneuver.phase=[{name='climb',duration_s=2.0,displacement_m=[0.0,0.0,-0.5]}]", "controller.horizon=5")
FORGED, RATE_HZ = 1000, 10_000
# Of the flood, what comes to each process at the least: the burst that is free, however slow the host.
FLOODED = 500


def calm(folder: Path, *changes: str) -> list[dict[str, str]]:
    """Steps of the same flight with no network at all."""
    flown(Setup.of(read_scenario(find_scenario("paper"), changes), "paper"), folder)
    write_report(folder, figures=False)
    return table(folder)


@pytest.mark.slow
@pytest.mark.parametrize("sort", ["replayed", "renumbered"])
def test_a_run_under_attack(sort: str, tmp_path: Path) -> None:
    """Strangers, forgers and a flood of 10,000 messages a second on agent 1's own key change no bit of a lockstep run.

    Forged messages come to nobody; the flood does, and is counted. That its numbers are above those of agent 1 itself
    keeps nobody from hearing agent 1.
    """
    base, keys = free_base(), Keys("out")
    secure = (f"network.base_port={base}", f"network.keys={keyring('one')}")
    scenario = Setup.of(read_scenario(find_scenario("paper"), (*FLIGHT, *secure)), "paper").scenario
    count = len(process_names(scenario))
    endpoints = [f"tls/127.0.0.1:{base + i}" for i in range(count)]
    changes = settings(*FLIGHT, *secure)
    run = start("run", "paper", *changes, "--out", "out", "--no-figures", "--format", "json", cwd=tmp_path)
    words = [sys.executable, "-m", "tests.support.attack", "out", "1", str(RATE_HZ), sort, str(keyring("one"))]
    with subprocess.Popen([*words, *endpoints], stdout=subprocess.PIPE, text=True) as flood:
        assert wait_for(is_flying(tmp_path / "out", process_names(scenario)))
        refused: list[str] = []
        knocking = threading.Thread(target=_knock, args=(endpoints[0], refused))
        knocking.start()
        with attack.session(endpoints, attack.tls(keyring("one"), "agent1")) as forger:
            for key in ("plan/2", "tick", "control", "plant_state", "measurement/3", "rejected/agent2"):
                for _ in range(FORGED):
                    attack.say(forger, f"{keys.prefix}/{key}", b"?")
            asked = transport("status", "--run", "out", "--process", "agent2", cwd=tmp_path)
            families = {family.name: family for family in Exporter("out", process_endpoints(scenario)).collect()}
            other = transport("status", "--run", "out", "--process", "agent7", cwd=tmp_path)
        printed, errors = run.communicate(timeout=PATIENCE_S)
        sent = int(flood.communicate(timeout=PATIENCE_S)[0])
        knocking.join()
    assert run.returncode == 0, errors
    assert refused == ["no certificate", "another authority", "no TLS"]
    summary: dict[str, Any] = json.loads(printed)
    assert summary["outcome"] == "completed"
    assert table(tmp_path / "out") == calm(tmp_path / "calm", *FLIGHT)

    counts = summary["rejections"]
    assert {entry["sender"] for entry in counts} == {"agent1"}  # the forger's own are not among them
    assert {entry["reason"] for entry in counts} <= {"replayed", "past", "wrong_sender"}
    for name in process_names(scenario):
        came = sum(entry["count"] for entry in counts if entry["by"] == name)
        assert FLOODED < came <= sent, name

    health = json.loads(asked.stdout)
    assert (health["name"], health["incarnation"]) == ("agent2", 0)
    assert abs(health["clock_offset_s"]) <= health["clock_uncertainty_s"] + 1e-3  # one clock: there is no offset
    assert health["memory_bytes"] > 1e7
    up = {sample.labels["process"]: sample.value for sample in families["transport_up"].samples}
    assert up == dict.fromkeys(process_names(scenario), 1.0)
    assert all(sample.value > 1e7 for sample in families["transport_memory_bytes"].samples)
    assert len(families["transport_refused_messages"].samples) == count
    assert other.returncode == 2
    assert "expected one of coordinator, plant, agent1" in other.stderr


def _knock(endpoint: str, refused: list[str]) -> None:
    """Try to get in without the right keys; notes what did not."""
    one, other = keyring("one"), keyring("other")
    for what, at, secure in (
        ("no certificate", endpoint, attack.tls(None, "", one / "ca.pem")),
        ("another authority", endpoint, attack.tls(other, "agent1", one / "ca.pem")),
        ("no TLS", endpoint.replace("tls/", "tcp/"), None),
    ):
        try:
            with attack.session([at], secure, 0.7):
                pass
        except zenoh.ZError:
            refused.append(what)


@contextmanager
def routers(folder: Path, *each: Sequence[str]) -> Iterator[None]:
    """`transport router` with arguments, one after the other; each has to end in order."""
    started: list[subprocess.Popen[str]] = []
    try:
        for arguments in each:
            started.append(start("router", *arguments, cwd=folder))
            err = started[-1].stderr
            assert err is not None
            assert "listening" in err.readline()
        yield
    finally:
        for process in started:
            process.terminate()
        for process in started:
            _, errors = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 0, errors


@pytest.mark.slow
def test_passwords_through_a_router(tmp_path: Path) -> None:
    """Clients of a router who prove their names by passwords fly the same flight; with a wrong one nobody gets in."""
    make_passwords(tmp_path / "keys", NAMES)
    at = f"tcp/127.0.0.1:{free_base()}"
    changes = settings(*BRIEF, f"network.router={at}", "network.keys=keys")
    with routers(tmp_path, ["--listen", at, "--set", "network.keys=keys"]):
        flight = transport("run", "paper", *changes, "--out", "out", "--no-figures", cwd=tmp_path)
        (tmp_path / "keys" / "agent3.password").write_text("wrong")
        wrong = transport("agent", "--id", "3", *changes, "--join-timeout", "1", cwd=tmp_path)
    assert flight.returncode == 0, flight.stderr
    assert table(tmp_path / "out") == calm(tmp_path / "calm", *BRIEF)
    assert wrong.returncode == 4
    assert "agent3: no router lets it in at" in wrong.stderr


@pytest.mark.slow
def test_routers_on_both_sides(tmp_path: Path) -> None:
    """Coordinator, plant and recorder here, agents behind a router of their own: the same flight, bit for bit."""
    base = free_base()
    here, there = f"tls/127.0.0.1:{base}", f"tls/127.0.0.1:{base + 1}"
    keys = f"network.keys={keyring('one')}"
    own = {
        "agents": settings(*BRIEF, keys, f"network.router={there}"),
        "": settings(*BRIEF, keys, f"network.router={here}"),
    }
    with routers(
        tmp_path,
        ["--listen", here, "--set", keys],
        ["--listen", there, "--connect", here, "--set", keys],
    ):
        started = [
            start("agent", "--id", str(i), "--scenario", "paper", *own["agents"], "--incarnation", "0", cwd=tmp_path)
            for i in range(1, 5)
        ]
        started.append(start("plant", "--scenario", "paper", *own[""], "--incarnation", "0", cwd=tmp_path))
        observed = ["--observer", "recorder", "--incarnation", "0"]
        started.append(start("coordinator", "--scenario", "paper", *own[""], *observed, cwd=tmp_path))
        record = transport("record", "--scenario", "paper", *own[""], "--out", "out", "--no-figures", cwd=tmp_path)
        errors = [process.communicate(timeout=PATIENCE_S)[1] for process in started]
    assert record.returncode == 0, record.stderr
    assert [process.returncode for process in started] == [0] * 6, errors
    assert table(tmp_path / "out") == calm(tmp_path / "calm", *BRIEF)
    assert all('"clock_offset_ms"' in text for text in errors[:5])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--set", "network.host=0.0.0.0"], "network.host: expected a loopback address, or network.keys, or "),
        (["--set", "network.keys=nowhere"], "network.keys: expected a folder with ca.pem or passwords"),
        (["--set", "network.router=plant:7447"], "network.router=plant:7447: expected an endpoint such as tls/"),
        (["--set", "network.keys=KEYS", "--set", "network.router=tcp/127.0.0.1:1"], "network.router: expected tls/..."),
    ],
)
def test_refused_before_anything_starts(words: list[str], expected: str, tmp_path: Path) -> None:
    """Open to everybody, without keys that are asked for, or with half of them: one line, exit code 3, no folder."""
    given = [word.replace("KEYS", str(keyring("one"))) for word in words]
    for what in (["run", "paper", "--out", "out"], ["plant"]):
        result = transport(*what, *given, cwd=tmp_path)
        assert result.returncode == 3, result.stderr
        assert expected in result.stderr
        assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_insecure_is_said(tmp_path: Path) -> None:
    """Whoever insists may listen for everybody, and the log warns of it."""
    base = free_base()
    changes = settings("network.host=0.0.0.0", "network.insecure=true", f"network.base_port={base}")
    done = subprocess.run(
        command("plant", *changes, "--join-timeout", "0.2"),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 4  # nobody came
    first = json.loads(done.stderr.splitlines()[0])
    assert (first["event"], first["at"]) == ("insecure", f"tcp/0.0.0.0:{base + 1}")
