"""`transport doctor`: problems of a machine are found and named, with advice."""

import json
import socket
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from tests.support import runs
from tests.support.commands import free_base
from transport.cli.main import app
from transport.doctor import checks as doctor
from transport.doctor.checks import DoctorFinding
from transport.flight.local_processes import HarnessError
from transport.model.kernels import compiler
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.setup.team_run import TeamRun

HERE = runs.setup()
ROUTED = runs.setup("network.router=tcp/192.0.2.1:7447", "network.insecure=true")


def test_ports() -> None:
    """A taken port fails a scenario that names it, and is no failure otherwise."""
    base = free_base()
    run = runs.setup(f"network.base_port={base}")
    free = doctor.ports(run)
    assert (free.status, free.found) == ("ok", f"{base} to {base + 5} on 127.0.0.1 are free")
    assert "clients of tcp/192.0.2.1:7447" in doctor.ports(ROUTED).found
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
    # The step is measured with what the check of the kernels compiles.
    assert list(checks) == ["ports", "network", "kernels", "step", "wake-up", "cores"]
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


def test_findings_are_lines_with_their_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warnings do not fail: the last line counts both; a check after a failed one is made, too."""
    good = DoctorFinding("ok", "as it should be")
    poor = DoctorFinding("warn", "slow", "buy another")
    bad = DoctorFinding("fail", "broken", "mend it")
    monkeypatch.setattr(
        doctor,
        "CHECKS",
        {"a": lambda _: bad, "b": lambda _: good, "c": lambda _: poor, "d": lambda _: good},
    )
    result = CliRunner().invoke(app, ["doctor"])
    assert (result.exit_code, result.stdout.splitlines()) == (
        9,
        [
            f"{'fail a':17} broken", f"{'':17} -> mend it", f"{'ok   b':17} as it should be",
            f"{'warn c':17} slow", f"{'':17} -> buy another", f"{'ok   d':17} as it should be",
            "4 checks: 1 fail, 1 warn",
        ],
    )  # fmt: skip

    monkeypatch.setattr(doctor, "CHECKS", {"c": lambda _: poor})
    warned = CliRunner().invoke(app, ["doctor", "--format", "json"])
    assert (warned.exit_code, json.loads(warned.stdout)["ok"]) == (0, True)


def test_a_taken_port_matters_only_to_a_scenario_that_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`transport run` takes any free ports; an address of another machine is of no use to it."""

    def taken(_host: str, _ports: object) -> None:
        raise HarnessError("network.base_port: expected free ports, got 7447, which is taken")

    monkeypatch.setattr(doctor, "reserved_ports", taken)
    assert doctor.ports(HERE).status == "warn"
    assert doctor.ports(runs.setup("network.base_port=9000")).status == "fail"


@pytest.mark.parametrize(
    ("times_ms", "status"),
    [([20.0] * 20, "ok"), ([20.1] * 20, "warn"), ([1.0] * 19, "fail"), ([], "fail")],
)
def test_all_round_trips_have_an_answer_in_time(
    times_ms: list[float], status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The median decides: 20 ms are those of a busy machine."""
    monkeypatch.setattr(doctor, "_round_trips_ms", lambda _: times_ms)
    assert doctor.network(HERE).status == status


@pytest.mark.parametrize(("late_ms", "status"), [(1.9, "ok"), (2.1, "warn")])
def test_a_single_late_wake_up_is_enough_to_warn(
    late_ms: float, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A deadline is missed once, too: the latest of forty decides, not the median."""
    delays_s = iter([1e-3 * late_ms, *[0.0] * 39])
    now_s = [0.0]

    def sleep(duration_s: float) -> None:
        now_s[0] += duration_s + next(delays_s)

    monkeypatch.setattr(doctor, "time", SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    finding = doctor.wake_up(HERE)
    assert finding.status == status
    assert f"at most {late_ms:.2f} ms" in finding.found


@pytest.mark.parametrize(
    ("compiled", "is_enabled", "c_compiler", "found", "advice"),
    [
        ((True, True), True, "cc", "compiled for this processor, vectors of 4 doubles", ""),
        ((False, True), True, "cc", "cc fails, or ", "install gcc or clang"),
        ((True, False), True, "cc", "cc fails, or ", "install gcc or clang"),
        ((False, True), True, None, "no C compiler: ", "install gcc or clang"),
        ((False, False), False, "cc", "switched off: ", "unset PAYLOAD_TRANSPORT_NATIVE"),
    ],
)
def test_what_keeps_a_step_from_being_compiled_is_told(
    compiled: tuple[bool, bool],
    is_enabled: bool,
    c_compiler: str | None,
    found: str,
    advice: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Kernels and model both have to be; advice is for the cause."""
    has_kernels, has_model = compiled
    kernels = SimpleNamespace(vector_width=lambda: 4)
    monkeypatch.setattr(doctor, "native", SimpleNamespace(AVAILABLE=has_kernels, KERNELS=kernels))
    monkeypatch.setattr(doctor, "compile_functions", lambda *_: has_model)
    monkeypatch.setattr(compiler, "enabled", lambda: is_enabled)
    monkeypatch.setattr(compiler, "find_compiler", lambda: c_compiler)
    finding = doctor.kernels(HERE)
    assert finding.status == ("warn" if advice else "ok")
    assert finding.found.startswith(found)
    assert finding.advice.startswith(advice)


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
    """The first ones, which load libraries, do not count; the model is that compiled by now."""
    durations_s = iter([9.0, 9.0, *[step_s] * 10])
    now_s = [0.0]

    class Agent:
        def __init__(self, run: TeamRun, *_: object) -> None:
            assert run.model is not HERE.model

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
