"""Complete runs with keys: under attack, through routers, and their health during the run."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support import attacker
from tests.support.attacker import table
from tests.support.commands import (
    PATIENCE_S,
    Forked,
    free_base,
    is_flying,
    settings,
    start,
    wait_for,
)
from tests.support.keyrings import keyring
from tests.support.logs import record_run
from tests.support.results import here
from tests.support.runs import ready
from transport.cli.hosts.prometheus_metrics import Exporter, process_endpoints
from transport.cli.main import app
from transport.protocol.network.mesh import process_names
from transport.protocol.wire.key_expressions import Keys
from transport.report.report import write_report

# Paced to real time, so that attackers have time; 6 s.
FLIGHT = (
    "maneuver.phase=[{name='climb',duration_s=6.0,displacement_m=[0.0,0.0,-1.0]}]",
    "controller.horizon=5",
    "clock.speed=1.0",
)
# As fast as possible.
BRIEF = (
    "maneuver.phase=[{name='climb',duration_s=2.0,displacement_m=[0.0,0.0,-0.5]}]",
    "controller.horizon=5",
)
FORGED, RATE_HZ = 1000, 200
FORGED_KEYS = (
    *("plan/2", "tick", "control", "plant_state", "measurement/3", "rejected/agent2"),
    *("answer/2", "relay", "instant", "record"),
)
# Minimum number of repeated messages at each process.
FLOODED = 20


def calm(folder: Path, *changes: str) -> list[dict[str, str]]:
    """Return the steps of the same run in memory."""
    record_run(ready("paper", *changes), folder)
    write_report(folder, figures=False)
    return table(folder)


@pytest.mark.slow
def test_a_run_under_attack(tmp_path: Path) -> None:
    """Forgery and repeated messages on agent 1's key do not change a lockstep run.

    Forged messages reach no process. Repeated ones reach all and are counted; agent 1's own are
    still accepted.
    """
    base, keys = free_base(), Keys("out")
    secure = (f"network.base_port={base}", f"network.keys={keyring('one')}")
    scenario = ready("paper", *FLIGHT, *secure).scenario
    count = len(process_names(scenario))
    endpoints = [f"tls/127.0.0.1:{base + i}" for i in range(count)]
    changes = settings(*FLIGHT, *secure)
    run = start(
        "run", "paper", *changes, "--out", "out", "--no-figures", "--format", "json", cwd=tmp_path
    )
    repeating = [
        sys.executable,
        "-m",
        "tests.support.attacker",
        "out",
        "1",
        str(RATE_HZ),
        str(keyring("one")),
    ]
    with subprocess.Popen([*repeating, *endpoints], stdout=subprocess.PIPE, text=True) as flood:
        assert wait_for(is_flying(tmp_path / "out", process_names(scenario)))
        with attacker.session(endpoints, attacker.tls(keyring("one"), "agent1")) as forger:
            # Asked within this process: on a busy host the run would end before a new process has
            # started.
            status = ["status", "--format", "json", "--run", str(tmp_path / "out"), "--process"]
            asked, other = (
                CliRunner().invoke(app, [*status, name]) for name in ("agent2", "agent7")
            )
            exporter, families = Exporter("out", process_endpoints(scenario)), dict[str, Any]()

            def all_answer() -> (
                bool
            ):  # each in time, once: on a busy host a process may be late in a reading
                families.update({family.name: family for family in exporter.collect()})
                return all(sample.value for sample in families["transport_up"].samples)

            assert wait_for(all_answer)
            for key in FORGED_KEYS:
                for _ in range(FORGED):
                    attacker.say(forger, f"{keys.prefix}/{key}", b"?")
        printed, errors = run.communicate(timeout=PATIENCE_S)
        sent = int(flood.communicate(timeout=PATIENCE_S)[0])
    assert run.returncode == 0, errors
    summary: dict[str, Any] = json.loads(printed)
    assert summary["outcome"] == "completed"
    assert table(tmp_path / "out") == calm(tmp_path / "calm", *FLIGHT)

    counts = summary["rejections"]
    assert {entry["sender"] for entry in counts} == {"agent1"}  # without the forged ones
    assert {entry["reason"] for entry in counts} <= {"replayed", "past", "wrong_sender"}
    for name in process_names(scenario):
        came = sum(entry["count"] for entry in counts if entry["by"] == name)
        assert FLOODED < came <= sent, name

    health = json.loads(asked.stdout)
    assert (health["name"], health["incarnation"]) == ("agent2", 0)
    assert health["memory_bytes"] > 1e7
    assert {sample.labels["process"] for sample in families["transport_up"].samples} == set(
        process_names(scenario)
    )
    assert all(sample.value > 1e7 for sample in families["transport_memory_bytes"].samples)
    assert len(families["transport_refused_messages"].samples) == count
    assert other.exit_code == 2
    assert "expected one of coordinator, plant, agent1" in other.stderr


@contextmanager
def routers(forked: Callable[..., Forked], folder: Path, *each: Sequence[str]) -> Iterator[None]:
    """Run `transport router` with each list of arguments; each has to end with exit code 0."""
    started: list[Forked] = []
    for arguments in each:
        started.append(forked("router", *arguments, cwd=folder))
        assert wait_for(lambda: "listening" in started[-1].output.read_text())
    yield
    for router in started:
        router.process.terminate()
    for router in started:
        code, printed = router.end()
        assert code == 0, printed


@pytest.mark.slow
def test_routers_on_both_sides(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """With coordinator, plant and recorder at one router and the agents at another, the run is bitwise the same."""
    base = free_base()
    here, there = f"tls/127.0.0.1:{base}", f"tls/127.0.0.1:{base + 1}"
    keys = f"network.keys={keyring('one')}"
    own = {
        "agents": settings(*BRIEF, keys, f"network.router={there}"),
        "": settings(*BRIEF, keys, f"network.router={here}"),
    }
    with routers(
        forked,
        tmp_path,
        ["--listen", here, "--set", keys],
        ["--listen", there, "--connect", here, "--set", keys],
    ):
        observed = ("--observer", "recorder")
        roles = [
            *(["agent", "--id", str(i), *own["agents"]] for i in range(1, 5)),
            ["plant", *own[""]],
            ["coordinator", *own[""], *observed],
        ]
        each = ("--scenario", "paper", "--incarnation", "0")
        record = ["record", "--scenario", "paper", *own[""], "--out", "out", "--no-figures"]
        all_words = [*([*role, *each] for role in roles), record]
        ended = [process.end() for process in [forked(*w, cwd=tmp_path) for w in all_words]]
    codes, outputs = zip(*ended, strict=True)
    assert codes == (0,) * len(ended), outputs
    assert table(tmp_path / "out") == calm(tmp_path / "calm", *BRIEF)
    assert all('"joined"' in text for text in outputs[:5])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            ["--set", "network.host=0.0.0.0"],
            "network.host: expected a loopback address, or network.keys, or ",
        ),
        (["--set", "network.keys=nowhere"], "network.keys: expected a folder with ca.pem"),
        pytest.param(
            ["--set", "network.router=plant:7447"],
            "network.router=plant:7447: string should match pattern",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["--set", "network.keys=KEYS", "--set", "network.router=tcp/127.0.0.1:1"],
            "network.keys: expected tls/... with these keys",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_refused_before_anything_starts(
    options: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Open addresses and missing or incomplete keys are refused: one line, exit code 3, no folder."""
    monkeypatch.chdir(tmp_path)
    given = [word.replace("KEYS", str(keyring("one"))) for word in options]
    for command_line in (["run", "paper", "--out", "out"], ["plant"]):
        result = here(*command_line, *given)
        assert result.exit_code == 3, result.stderr
        assert expected in result.stderr
        said = [
            line
            for line in result.stderr.splitlines()
            if not line.startswith("compiling the model")
        ]
        assert len(said) == 1
    assert not (tmp_path / "out").exists()


def test_insecure_is_logged(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """With `network.insecure` a process listens on an open address and logs a warning."""
    base = free_base()
    changes = settings("network.host=0.0.0.0", "network.insecure=true", f"network.base_port={base}")
    code, printed = forked("plant", *changes, "--join-timeout", "0.2", cwd=tmp_path).end()
    assert code == 4  # no other process joined
    first = json.loads(printed.splitlines()[0])
    assert (first["event"], first["means"][:20]) == ("open", "any host with access")
