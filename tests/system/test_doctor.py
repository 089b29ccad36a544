"""`transport doctor`: problems of a machine are found and named, with advice."""

import json
import socket
from collections.abc import Callable

import pytest
from typer.testing import CliRunner

from tests.support import runs
from tests.support.commands import free_base
from transport.cli.main import app
from transport.doctor import checks as doctor
from transport.doctor.checks import DoctorFinding
from transport.protocol.scenario.setup.run_setup import Setup

HERE = runs.setup()


def test_ports() -> None:
    """A taken port fails a scenario that names it, and is no failure otherwise."""
    base = free_base()
    run = runs.setup(f"network.base_port={base}")
    assert doctor.ports(run).status == "ok"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", base + 2))
        taken.listen()
        check = doctor.ports(run)
    assert check.status == "fail"
    assert str(base + 2) in check.found
    assert "network.base_port" in check.advice


@pytest.mark.parametrize("check", [doctor.ports, doctor.network])
def test_an_address_of_another_machine(check: Callable[[Setup], DoctorFinding]) -> None:
    """Both checks that listen on it advise another address."""
    away = check(runs.setup("network.host='192.0.2.1'"))  # reserved for documentation
    assert away.status == "fail"
    assert "address of this machine" in away.advice


def test_command() -> None:
    """The command makes all checks, with real network sessions, and its exit code is that of a failure if any fails."""
    result = CliRunner().invoke(app, ["doctor", "resilient", "--format", "json"])
    content = json.loads(result.stdout)
    checks = {check["name"]: check for check in content["checks"]}
    failed = [check for check in checks.values() if check["status"] == "fail"]
    assert failed == [], result.output
    assert (result.exit_code, content["ok"], content["scenario"]) == (0, True, "resilient")
    assert "a round trip takes" in checks["network"]["found"]
    assert checks.keys() == doctor.CHECKS.keys()
    assert all(check["advice"] for check in checks.values() if check["status"] != "ok")


def test_exit_code_of_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that raises fails; a failed check is shown and gives exit code 9."""

    def broken(setup: object) -> DoctorFinding:
        raise OSError("no such luck")

    monkeypatch.setattr(doctor, "CHECKS", {"cores": doctor.cores, "network": broken})
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 9
    assert "OSError: no such luck" in result.output
    assert "1 fail" in result.output


@pytest.mark.parametrize(("cores", "status"), [(6, "warn"), (7, "ok")])
def test_each_process_and_the_recorder_want_a_core(
    cores: int, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four agents, plant, coordinator and recorder."""
    monkeypatch.setattr("joblib.cpu_count", lambda: cores)
    finding = doctor.cores(HERE)
    assert finding.status == status
    assert finding.found.startswith(f"{cores} for 7 processes")
    assert bool(finding.advice) is (status == "warn")


@pytest.mark.parametrize(("step_s", "status"), [(0.024, "ok"), (0.026, "warn")])
def test_a_step_may_take_half_a_period(
    step_s: float, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first ones, which load libraries, do not count."""
    durations_s = iter([9.0, 9.0, *[step_s] * 10])
    now_s = [0.0]

    class Agent:
        def __init__(self, *_: object) -> None:
            pass

        def warm_up(self) -> None:
            now_s[0] += next(durations_s)

    monkeypatch.setattr(doctor, "AgentNode", Agent)
    monkeypatch.setattr("time.perf_counter", lambda: now_s[0])
    finding = doctor.step(HERE)
    assert finding.status == status
    assert f"takes {1e3 * step_s:.1f} ms, a sampling period is 50 ms" in finding.found


def test_scenario_is_checked() -> None:
    """A refused scenario has its own exit code, as in all commands."""
    result = CliRunner().invoke(app, ["doctor", "--set", "controller.horizon=0"])
    assert result.exit_code == 3
