"""`transport doctor`: problems of a machine are found and named, with advice."""

import json
import socket
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from typer.testing import CliRunner

from tests.support import runs
from tests.support.commands import free_base
from transport.cli.main import app
from transport.doctor import checks as doctor
from transport.doctor.checks import Finding

HERE = runs.setup()


@pytest.mark.parametrize(
    ("name", "path", "good", "bad", "advice"),
    [
        (
            "governor",
            "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor",
            *("performance", "powersave", "cpupower"),
        ),
        ("quota", "sys/fs/cgroup/cpu.max", "max 100000", "150000 100000", "cpuset-cpus"),
    ],
)
def test_host(
    name: str, path: str, good: str, bad: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suitable host is ok, an unsuitable one gets a warning with advice, one without the file is ok."""
    monkeypatch.setattr(doctor, "_ROOT", tmp_path)
    check, file = doctor.CHECKS[name], tmp_path / path
    assert check(HERE).status == "ok"
    file.parent.mkdir(parents=True)
    file.write_text(good)
    assert (check(HERE).status, check(HERE).advice) == ("ok", "")
    file.write_text(bad)
    assert check(HERE).status == "warn"
    assert advice in check(HERE).advice


def test_swap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Swap is a warning with advice."""
    monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(total=10**9))
    finding = doctor.CHECKS["memory"](HERE)
    assert (finding.status, "swapoff" in finding.advice) == ("warn", True)


def test_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing or outdated package fails the check and is named; one of an extra does not fail."""
    assert doctor.packages(HERE).status == "ok"
    required = ["numpy>=999", "no-such-package>=2", "scipy", 'another-one; extra == "test"']
    monkeypatch.setattr(metadata, "requires", lambda _: required)
    wrong = doctor.packages(HERE)
    assert wrong.status == "fail"
    assert f"numpy {metadata.version('numpy')} (needs >=999)" in wrong.found
    assert "no-such-package is missing (needs >=2)" in wrong.found
    assert "scipy" not in wrong.found
    assert "another-one" not in wrong.found


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
    away = doctor.ports(runs.setup("network.host='192.0.2.1'"))  # an address reserved for documentation
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

    def broken(setup: object) -> Finding:
        raise OSError("no such luck")

    monkeypatch.setattr(doctor, "CHECKS", {"disk": doctor.disk, "network": broken})
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 9
    assert "OSError: no such luck" in result.output
    assert "1 fail" in result.output


def test_scenario_is_checked() -> None:
    """A refused scenario has its own exit code, as in all commands."""
    result = CliRunner().invoke(app, ["doctor", "--set", "controller.horizon=0"])
    assert result.exit_code == 3
