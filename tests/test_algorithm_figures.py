"""docs/algorithm_figures.py: distances from the optimum, rows and words of hand-made runs, and what is flown anew."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import orjson
import pytest
from msgspec import structs

from tests.support.logs import log_of
from tests.support.runs import plant_state, setup
from transport.protocol.wire.messages import PlantState

ROOT = Path(__file__).resolve().parents[1]
LARGE = 0.1  # distance of an input from the optimum, of half its range
SAME = 1e-6


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program, with the examples that it imports when it needs them, anew in each test."""
    for folder in ("docs", "examples/controllers"):
        monkeypatch.syspath_prepend(str(ROOT / folder))
    for name in ("prediction", "program", "admm"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("algorithm_figures")


def flight(outcome: str, end_s: float, cost: float) -> Any:
    """Return a run as the program has it, with the numbers of its row."""
    summary = {
        "outcome": outcome,
        "cost": {"mean": cost},
        "payload_tracking": {"rms_m": 0.123},
        "agent_step_ms": {"p50": 4.567},
    }
    series = SimpleNamespace(times_s=np.array([0.0, end_s]))
    return SimpleNamespace(series=series, summary=summary, completed=outcome == "completed")


def test_a_row_has_costs_ends_and_what_holds_on_the_perfect_network(program: Any) -> None:
    """A run that diverged has its end in place of a cost; a network that was not flown has none."""
    runs = {"perfect": flight("completed", 25.0, 0.0123456), "late": flight("diverged", 7.25, 9.0)}
    assert program.row_of("admm:ADMM", runs) == [
        "`admm:ADMM` ([figure](../images/own_admm.png))",
        *("0.01235", "diverges at 7.2 s", "0.12 m", "4.57 ms"),
    ]
    alone = program.row_of("nmpc:NMPC", {"perfect": runs["perfect"]})
    assert alone[1:3] == ["0.01235", "no network"]


def test_distances_in_words(program: Any) -> None:
    """The first iteration below the bound, counted from 1; of a flight what comes after the first hover."""
    iterated = np.array([1e-1, 1e-3, 5e-5, 2e-6])
    times_s = np.array([1.0, 5.0, 6.0, 7.0, 8.0])
    distances = np.array([9.0, 9.0, 1e-3, 3e-3, 2e-3])
    assert program.in_words(iterated, {"late": (times_s, distances)}) == (
        "below 0.0001 from iteration 3 on, 2e-06 after 60; in flight, 200 ms delay, 30 % packet loss, "
        "from 5 s until 8.0 s: median 2e-03, largest 3e-03"
    )


def test_the_optimum_of_a_hover_is_the_hover(program: Any) -> None:
    """An applied input that is a tenth of half its range off has this distance, at the instant of its tick."""
    run = setup()
    half_range = (run.settings.upper(run.system.N) - run.settings.lower(run.system.N)) / 2.0
    states: list[PlantState] = []
    for tick, off in enumerate((0.0, LARGE, 0.5)):  # the first and the last are not judged
        u = run.hover.u.copy()
        u[5] += off * half_range[5]
        states.append(structs.replace(plant_state(run, tick), u=u))
    times_s, distances = program.distances_in_flight(SimpleNamespace(log=log_of(states)), run)
    np.testing.assert_allclose(times_s, [run.settings.sampling_period_s])
    np.testing.assert_allclose(distances, [LARGE], atol=SAME)


def test_what_a_commit_has_flown_is_not_flown_again(
    program: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The table has the rows of all that is flown in their order, and the note of ADMM; names ask for runs anew."""
    flown: list[str] = []

    def fly(name: str) -> None:
        flown.append(name)
        note = "so near" if name == "admm:ADMM" else ""
        program.file_of(name).write_bytes(orjson.dumps({"row": [name], "note": note}))

    page = tmp_path / "page.md"
    page.write_text("<!-- ready algorithms -->\n\n<!-- end of ready algorithms -->\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "PAGE", page)
    monkeypatch.setattr(program, "fly", fly)
    monkeypatch.setattr(program, "machine", lambda: "a machine")
    monkeypatch.setattr(
        program, "file_of", lambda name: tmp_path / f"{name.partition(':')[0]}.json"
    )
    fly("paper:Paper")
    program.main([])
    assert flown == ["paper:Paper", *(name for name in program.ALGORITHMS if name != "paper:Paper")]
    rows = [line for line in page.read_text().splitlines() if line.startswith("|")][2:]
    assert rows == [f"| {name} |" for name in program.ALGORITHMS]
    assert "Machine: a machine. ADMM's distance from the optimum: so near." in page.read_text()

    flown.clear()
    program.main([])
    program.main(["alone:Alone"])
    assert flown == ["alone:Alone"]


@pytest.mark.parametrize(
    ("name", "networks", "note"),
    [
        ("admm:ADMM", ["perfect", "late"], "so near"),
        ("paper:Paper", ["perfect", "late"], ""),
        ("nmpc:NMPC", ["perfect"], ""),  # one agent for all has no network
    ],
)
def test_an_algorithm_is_flown_on_its_networks(
    program: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    name: str,
    networks: list[str],
    note: str,
) -> None:
    """Its row is kept, and for ADMM the note on its distance from the optimum."""
    drawn: list[Any] = []
    is_one = name == "nmpc:NMPC"  # whose package not every machine has
    monkeypatch.setattr(program, "entered", lambda _: SimpleNamespace(centralized=is_one))
    monkeypatch.setattr(program, "flown", lambda *given: given)
    monkeypatch.setattr(program, "draw", lambda *given: drawn.append(given))
    monkeypatch.setattr(program, "draw_admm", lambda _runs: (tmp_path, "so near"))
    monkeypatch.setattr(program, "row_of", lambda *_: ["a row"])
    monkeypatch.setattr(program, "file_of", lambda _: tmp_path / "kept" / "file.json")
    program.fly(name)
    assert drawn == [(name, {network: (name, network) for network in networks})]
    kept = orjson.loads((tmp_path / "kept" / "file.json").read_bytes())
    assert kept == {"row": ["a row"], "note": note}
