"""The benchmark of two versions in turns: which value counts for which version, and what it refuses."""

import ast
import importlib
import json
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import against
from docs.tables import ROOT

BEFORE, NOW = Path("before"), Path("now")
VERSIONS = {"before": (BEFORE, {"CACHE": "1"}), "now": (NOW, {"CACHE": "2"})}


def test_versions_are_measured_in_turns_and_the_first_turn_is_left_out() -> None:
    """It compiles the models: each version has one value for each turn after it."""
    measured = []

    def count(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
        measured.append((tree, environment["CACHE"]))
        return {"calls": float(len(measured)), "negative": -float(len(measured))}

    assert against.in_turns(count, VERSIONS, 2) == {
        "calls": {"before": [3.0, 5.0], "now": [4.0, 6.0]},
        "negative": {"before": [-3.0, -5.0], "now": [-4.0, -6.0]},
    }
    assert measured == [(BEFORE, "1"), (NOW, "2")] * 3


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        ([4.0, 2.0, 9.0], [1.0, 3.0, 1.0], ["4.00", "1.00", "0.25"]),  # medians, not means
        ([1.0], [4.0], ["1.00", "4.00", "4.00"]),
        ([0.0], [2.0], ["0.00", "2.00", ""]),
    ],
)
def test_cells_have_medians_and_their_ratio(
    before: list[float], now: list[float], expected: list[str]
) -> None:
    """The ratio is below 1 where this version is the smaller one; none to 0."""
    cells = against.cells("a quantity", {"before": before, "now": now})
    assert cells == ["a quantity", *expected]


def test_each_version_has_a_cache_of_its_own() -> None:
    """Models that one has compiled are none of the other's; the environment is otherwise the same."""
    trees = {"before": BEFORE, "now": NOW}
    assert against.versions_of(trees, {"CC": "cc"}, Path("caches")) == {
        "before": (BEFORE, {"CC": "cc", "PAYLOAD_TRANSPORT_CACHE": "caches/before"}),
        "now": (NOW, {"CC": "cc", "PAYLOAD_TRANSPORT_CACHE": "caches/now"}),
    }


def test_the_program_of_a_run_in_memory_names_what_there_is() -> None:
    """It runs in the other interpreter: neither imports nor calls are checked where it is kept."""
    for node in ast.walk(ast.parse(against.IN_MEMORY)):
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            assert [name.name for name in node.names if not hasattr(module, name.name)] == []


def test_the_program_of_a_run_in_memory_tells_the_fastest_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of as many as asked for, after one that does not count."""
    runs: list[Any] = []
    now_s = iter([0.0, 5.0, 10.0, 12.5, 20.0, 24.0])
    for name, stand_in in (
        ("transport.cli.options.read_setup", lambda *_, **__: SimpleNamespace(scenario=None)),
        ("transport.flight.progress.compile_models", lambda *_: None),
        ("transport.flight.memory.simulate", runs.append),
        ("time.process_time", lambda: next(now_s)),
        ("gc.disable", lambda: None),
    ):
        monkeypatch.setattr(name, stand_in)
    monkeypatch.setattr(sys, "argv", ["-c", "paper", "3"])
    exec(against.IN_MEMORY, {})  # noqa: S102 - as the other interpreter does
    assert capsys.readouterr().out == "2.5\n"
    assert len(runs) == 4


@pytest.mark.parametrize(
    ("uavs", "quantity"),
    [
        (0, "`paper` in memory, s of processor time"),
        (16, "`paper`, N = 16 in memory, s of processor time"),
    ],
)
def test_a_team_in_memory_may_have_another_size(
    uavs: int, quantity: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is made by the version that is measured; the program prints its time last."""
    commands: list[list[str]] = []

    def run(command: list[str], **_: object) -> Any:
        commands.append(command)
        return SimpleNamespace(stdout="compiled 1\n2.5\n")

    monkeypatch.setattr("benchmarks.against.subprocess.run", run)
    assert against.in_memory("paper", uavs, runs=3)(NOW, {}) == {quantity: 2.5}
    *made, (python, *_, scenario, count) = commands
    assert (python, count) == (against.python_of(NOW), "3")
    if uavs:
        ((*command, file),) = made
        assert command[:4] == [python, "-P", "-m", "transport"]
        assert command[4:] == ["scenario", "new", "--uavs", "16", "--from", "paper", "--out"]
        assert file == scenario
    else:
        assert (made, scenario) == ([], "paper")


def test_a_run_with_processes_has_a_begin_and_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processor time is that of user and system, of this run alone."""
    used = iter(
        [SimpleNamespace(ru_utime=1.0, ru_stime=2.0), SimpleNamespace(ru_utime=4.0, ru_stime=7.0)]
    )
    at_s = {"first tick": 1.25, "last tick": 4.0, "prompt": 4.5}
    monkeypatch.setattr("resource.getrusage", lambda _: next(used))
    monkeypatch.setattr(against, "instants", lambda *_: at_s)
    assert list(against.with_processes(NOW, {}).values()) == [8.0, 1.25, 0.5]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [("fpu avx2 avx512f", ["AVX-512", "AVX2"]), ("fpu avx2", [platform.machine()])],
)
def test_a_processor_with_avx512_is_measured_without_it_as_well(
    flags: str, expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a compiler that is told to leave AVX-512 out; native models switched off are on in all."""
    for name in ("PAYLOAD_TRANSPORT_NATIVE", "PYTHONDONTWRITEBYTECODE"):
        monkeypatch.setenv(name, "0")
    monkeypatch.delenv("CC", raising=False)
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"flags : {flags}\n", encoding="utf-8")

    found = against.environments(tmp_path, cpuinfo)
    assert list(found) == expected
    for environment in found.values():
        assert not {"PAYLOAD_TRANSPORT_NATIVE", "PYTHONDONTWRITEBYTECODE"} & environment.keys()
    assert "CC" not in found[expected[0]]
    if "AVX2" in found:
        compiler = Path(found["AVX2"]["CC"])
        assert compiler.read_text(encoding="utf-8").endswith("-mno-avx512f\n")


def test_a_processor_that_the_machine_is_not_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error names those that can be measured."""
    monkeypatch.setattr(against, "environments", lambda _folder: {"AVX-512": {}, "AVX2": {}})
    monkeypatch.setattr(sys, "argv", ["against", "before", "--processor", "AVX512"])
    with pytest.raises(SystemExit):
        against.main()
    assert "--processor: this machine has AVX-512 and AVX2, not AVX512" in capsys.readouterr().err


def test_each_quantity_is_a_row_of_each_processor(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other version is in the first column; parts and processors are those that are asked for."""
    measured = []

    def time_of(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
        measured.append(tree)
        slower = 2.0 if environment["KIND"] == "AVX2" else 1.0
        return {"s": slower * (2.0 if tree == Path("before").resolve() else 3.0)}

    kinds = {kind: {"KIND": kind} for kind in ("AVX-512", "AVX2")}
    monkeypatch.setattr(against, "environments", lambda _folder: kinds)
    monkeypatch.setattr(against, "PARTS", {"paper": time_of, "other": lambda *_: {"other": 1.0}})
    given = ["against", "before", "--turns", "1", "--only", "paper"]
    monkeypatch.setattr(sys, "argv", given)
    assert against.main() == 0
    rows = capsys.readouterr().out.splitlines()[2:4]
    assert rows == ["| AVX-512 | s | 2.00 | 3.00 | 1.50 |", "| AVX2 | s | 4.00 | 6.00 | 1.50 |"]
    assert measured[:2] == [Path("before").resolve(), ROOT]

    monkeypatch.setattr(sys, "argv", [*given, "--processor", "AVX2"])
    assert against.main() == 0
    assert "AVX-512" not in capsys.readouterr().out


def test_missed_deadlines_are_a_share_of_all_agents_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """6 of 100 ticks of 3 agents are 2 %."""
    summary = {
        "deadline": {"missed": 6},
        "ticks": 100,
        "controller": {"owned": [[1], [2], [3, 4]]},
        "agent_step_ms": {"p50": 1.5, "p99": 9.0},
    }

    def run(command: list[str], **_: object) -> None:
        assert command[:6] == [against.python_of(NOW), "-P", "-m", "transport", "run", "resilient"]
        folder = Path(command[command.index("--out") + 1])
        folder.mkdir()
        (folder / "summary.json").write_text(json.dumps(summary))

    monkeypatch.setattr("benchmarks.against.subprocess.run", run)
    found = against.real_time(NOW, {})
    assert found == {"deadlines missed at 100 Hz, %": 2.0, "step at 100 Hz, ms": 1.5}
