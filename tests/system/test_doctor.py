"""`transport doctor`: problems of a machine are found and named, with advice."""

import json
import socket
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.support import runs
from tests.support.commands import free_base
from transport.cli.main import app
from transport.doctor import checks as doctor
from transport.doctor import run_checks
from transport.doctor.checks import Finding

STAT = "cpu  {user} 0 0 {idle} 0 0 0 {stolen} 0 0\n"


def put(root: Path, path: str, text: str) -> Path:
    """Write a file below a root and return the root."""
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return root


@pytest.mark.parametrize(
    ("check", "path", "good", "bad", "advice"),
    [
        (
            doctor.governor,
            "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
            "performance",
            "powersave",
            "cpupower",
        ),
        (doctor.quota, "sys/fs/cgroup/cpu.max", "max 100000", "150000 100000", "cpuset-cpus"),
        (doctor.load, "proc/loadavg", "0.00 0.1 0.1 1/100 7", "9999.0 1 1 1/100 7", "chrt"),
        (doctor.memory, "proc/swaps", "Filename Type\n", "Filename Type\n/dev/sda2 partition\n", "swapoff"),
        (
            doctor.clock,
            "sys/devices/system/clocksource/clocksource0/current_clocksource",
            "tsc",
            "acpi_pm",
            "tsc or kvm-clock",
        ),
        (
            doctor.steal,
            "proc/stat",
            STAT.format(user=500, idle=500, stolen=1),
            STAT.format(user=500, idle=400, stolen=100),
            "other guests",
        ),
    ],
)
def test_host(
    check: Callable[[Path], Finding],
    path: str,
    good: str,
    bad: str,
    advice: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A suitable host is ok, an unsuitable one gets a warning with advice, one without the file is ok."""
    monkeypatch.setattr(doctor, "_STEAL_S", 0.0)
    assert check(tmp_path / "nothing")[0] == "ok"
    status, found, nothing = check(put(tmp_path / "good", path, good))
    assert (status, nothing) == ("ok", ""), found
    status, found, advised = check(put(tmp_path / "bad", path, bad))
    assert status == "warn", found
    assert advice in advised


def test_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing or outdated package fails the check and is named; one of an extra does not fail."""
    assert [check.status for check in doctor.packages()] == ["ok", "ok"]
    required = ["numpy>=999", "no-such-package>=2", "scipy", 'another-one; extra == "test"']
    monkeypatch.setattr(metadata, "requires", lambda _: required)
    wrong, extras = doctor.packages()
    assert wrong.status == "fail"
    assert f"numpy {metadata.version('numpy')} (needs >=999)" in wrong.found
    assert "no-such-package is missing (needs >=2)" in wrong.found
    assert "scipy" not in wrong.found
    assert "test (another-one)" in extras.found
    assert [check.status for check in doctor.packages("no-such-distribution")] == ["fail"]


def test_ports() -> None:
    """A taken port fails a scenario that names it, and is no failure otherwise."""
    base = free_base()
    run = runs.setup(f"network.base_port={base}")
    assert run_checks.ports(run).status == "ok"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", base + 2))
        taken.listen()
        check = run_checks.ports(run)
    assert check.status == "fail"
    assert str(base + 2) in check.found
    assert "network.base_port" in check.advice
    away = run_checks.ports(runs.setup("network.host='192.0.2.1'"))  # an address reserved for documentation
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
    assert {
        "python",
        "ports",
        "step",
        "blas threads",
        "clock",
        "cores",
        "steal",
        "governor",
        "priority",
    } <= checks.keys()
    assert all(check["advice"] for check in checks.values() if check["status"] != "ok")


def test_exit_code_of_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that raises fails; a failed check is shown and gives exit code 9."""

    def broken(setup: object) -> Finding:
        raise OSError("no such luck")

    monkeypatch.setattr(run_checks, "network", broken)
    monkeypatch.setattr(doctor, "host_checks", lambda _: iter(()))
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 9
    assert "OSError: no such luck" in result.output
    assert "1 fail" in result.output


def test_scenario_is_checked() -> None:
    """A refused scenario has its own exit code, as in all commands."""
    result = CliRunner().invoke(app, ["doctor", "--set", "controller.horizon=0"])
    assert result.exit_code == 3
