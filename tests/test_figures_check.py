"""docs/figures.py --check: each kind of difference is reported, and renewal simulates what differs."""

import zipfile
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from transport.experiments.simulation import ERROR, Result, simulate
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

ROOT = Path(__file__).resolve().parent.parent
SHORT = ("maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.1]}]",)
# A table of a page with few scenarios, which are read within a tenth of a second.
TABLE = "negotiation_iterations"
OTHER_COMMIT = "of another day"


@pytest.fixture
def docs(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The modules of the folder docs."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    names = ("figures", "kept", "table_rows_and_cells")
    return SimpleNamespace(**{name: import_module(name) for name in names})


@pytest.fixture
def short(docs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A table of two short runs with its page and its kept results."""
    monkeypatch.setattr(docs.kept, "FOLDER", tmp_path)
    # In this process: others take seconds to start.
    monkeypatch.setattr(docs.figures.joblib, "cpu_count", lambda: 1)
    page = tmp_path / "page.md"
    page.write_text("<!-- short -->\n\n<!-- end of short -->\n")
    runs = {
        "paper": docs.table_rows_and_cells.Run("paper", SHORT),
        "late": docs.table_rows_and_cells.Run("paper", (*SHORT, "links.delay_s=0.2")),
    }
    columns = {"result": docs.table_rows_and_cells.outcome, "cost": docs.table_rows_and_cells.COST}
    table = docs.table_rows_and_cells.listed("short", "", runs, columns)
    one = replace(
        docs.table_rows_and_cells.measured("record/measured.md", table),
        document=page,
        is_timed=True,
    )
    kept_runs = docs.figures.complete(one, docs.figures.missing(one, {}))
    docs.figures.put(page, "short", docs.figures.text_of(one, kept_runs))
    return one


@pytest.fixture
def alone(docs: SimpleNamespace, short: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The short table as the only one of the project."""
    monkeypatch.setattr(docs.figures, "TABLES", {"short": lambda: short})
    monkeypatch.setattr(docs.figures, "PAGES", {})
    return short


@pytest.fixture
def simulated(docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The runs that are simulated from here on, in words."""
    texts: list[str] = []
    fly = docs.figures.fly

    def noted(tasks: Any, **options: bool) -> Any:
        texts.extend(task.text for task in tasks)
        return fly(tasks, **options)

    monkeypatch.setattr(docs.figures, "fly", noted)
    return texts


def change_a_digit(page: Path) -> None:
    """Change the last digit of a page."""
    text = page.read_text()
    index = max(i for i, letter in enumerate(text) if letter.isdigit())
    other = str((int(text[index]) + 1) % 10)
    page.write_text(text[:index] + other + text[index + 1 :])


def of_other_code(kept_run: Any) -> Any:
    """Return a kept run as one of another commit."""
    return replace(kept_run, origin=replace(kept_run.origin, commit=OTHER_COMMIT))


def renew(docs: SimpleNamespace, *, of_this_code: bool) -> None:
    """Renew the short table without pictures."""
    docs.figures.renew(["short"], of_this_code=of_this_code, seed=0, pictures=False)


def test_a_renewed_table_is_right(docs: SimpleNamespace, short: Any) -> None:
    """The page equals the kept results, and each of the runs, repeated, has their numbers."""
    assert docs.figures.problems_of_pages([short]) == []
    for seed in range(3):
        assert docs.figures.problems_of_drawn([short], seed) == []
    draws = {docs.figures.drawn(short, seed)[0].text for seed in range(9)}
    assert len(draws) == 2


def test_several_runs_are_drawn_of_the_whole_table(docs: SimpleNamespace) -> None:
    """Each once, large ones too; no more than there are."""
    one = docs.figures.TABLES["latency"]()
    runs = [task.text for task in docs.figures.drawn(one, 1, 6)]
    assert len(set(runs)) == len(runs) == 6
    assert len(docs.figures.drawn(one, 1, 1000)) == len(one.cases)


@pytest.mark.parametrize(("turn", "share"), [(1.01, 1.0), (0.25, 0.25)])
def test_tables_take_turns_by_the_work_of_their_runs(
    docs: SimpleNamespace, short: Any, monkeypatch: pytest.MonkeyPatch, turn: float, share: float
) -> None:
    """A short run is repeated each time, one of four times the work of a turn in a quarter of the draws."""
    (task,) = docs.figures.drawn(short, 0)
    monkeypatch.setattr(docs.figures, "_TURN", turn * docs.figures._work(task.case))
    draws = 400
    repeated = sum(docs.figures.in_turn([task], seed) != [] for seed in range(draws))
    assert repeated / draws == pytest.approx(share, abs=0.1)  # five standard deviations


def test_a_single_drawn_run_is_of_the_smaller_quarter(docs: SimpleNamespace) -> None:
    """A check of all tables must take minutes; several runs are drawn of all."""
    one = docs.figures.TABLES["teams"]()
    work = {case.key: docs.figures._work(case) for case in one.cases}
    quarter = sorted(work.values())[len(work) // 4]
    drawn = {docs.figures.drawn(one, seed)[0].case.key for seed in range(100)}
    assert drawn == {key for key, size in work.items() if size <= quarter}
    assert len(drawn) < len(work) / 2


def test_a_run_that_raised_ends_the_command(
    docs: SimpleNamespace, short: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error is no result: nothing is kept, and the table, the run and the error are named."""
    failed = Result(key="", outcome=ERROR, reason="ValueError: no", numbers={})
    monkeypatch.setattr(docs.figures, "map_on_cores", lambda *_: iter([(1, failed)]))
    tasks = docs.figures.missing(short, {})
    before = docs.kept.file_of("short").read_bytes()
    with pytest.raises(SystemExit, match=r"short: paper: .*: ValueError: no"):
        docs.figures.complete(short, tasks)
    assert docs.kept.file_of("short").read_bytes() == before


def test_a_check_draws_as_many_runs_as_asked_for(
    docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the tables whose pages are right, by the given seed."""
    tables = {name: SimpleNamespace(name=name) for name in ("right", "wrong")}
    monkeypatch.setattr(
        docs.figures, "TABLES", {n: lambda one=one: one for n, one in tables.items()}
    )
    monkeypatch.setattr(docs.figures, "problems_of_pages", lambda _tables: ["wrong: differs"])
    monkeypatch.setattr(docs.figures, "problems_of_drawn", lambda *given, turns: [(*given, turns)])
    for turns in (False, True):
        asked = ([tables["right"]], 7, 5, turns)
        found = docs.figures.check(["right", "wrong"], 7, 5, turns=turns)
        assert found == ["wrong: differs", asked]


def test_a_page_tells_the_origins_of_its_tables(
    docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once where all have one, else each with the names of its tables; one without results is an older one."""
    monkeypatch.setattr(docs.kept, "file_of", lambda name: name)
    monkeypatch.setattr(docs.kept, "read", lambda name: {"run": name[0]} if name != "none" else {})
    monkeypatch.setattr(docs.kept, "origin_lines", "".join)
    a1, a2, b, none = (SimpleNamespace(name=name) for name in ("a1", "a2", "b", "none"))
    assert docs.figures.origins_of_page([a1, a2]) == "a"
    assert docs.figures.origins_of_page([a1, b, a2, none]).split("\n\n") == [
        "`a1`, `a2`: a", "`b`: b", "`none`: *an earlier version, not yet renewed.*",
    ]  # fmt: skip


@pytest.mark.usefixtures("docs")
def test_the_comparison_has_timed_runs_and_runs_for_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results come in this order, each half with the cases and the experiment of its own."""
    program = import_module("results_page")
    monkeypatch.setattr(program, "swept", lambda *given: given)
    planned = SimpleNamespace(
        measurement="times", timed=["t1", "t2"], experiment="costs", cases=["c1", "c2", "c3"]
    )
    timed, costs = program._halves(planned, [1, 2, 3, 4, 5])
    assert timed == ("times", ["t1", "t2"], [1, 2])
    assert costs == ("costs", ["c1", "c2", "c3"], [3, 4, 5])


def test_a_run_is_found_by_its_scenario_and_seed(docs: SimpleNamespace) -> None:
    """Whatever addresses it uses, and whether a default is written out."""

    def run_id(*settings: str) -> str:
        return str(docs.kept.run_id(read_scenario(find_scenario("paper"), settings)))

    assert run_id("network.base_port=9000") == run_id("links.delay_s=0.0") == run_id()
    assert len({run_id(), run_id("seed=1"), run_id("links.delay_s=0.1")}) == 3


@pytest.mark.parametrize(
    ("before", "now", "is_same"),
    [
        (float("nan"), float("nan"), True),  # no UAV left that could be measured
        (float("nan"), 1.0, False),
        (None, None, True),
        (None, 0.0, False),
        (1e-10, -1e-10, True),  # rounding errors
        (0.0, 1e-8, False),
        (2.0, 2.00001, True),
        (2.0, -2.0, False),
    ],
)
def test_numbers_that_are_kept_and_repeated(
    docs: SimpleNamespace, before: float | None, now: float | None, is_same: bool
) -> None:
    """Six digits, of which the last may differ; a number that is missing differs from any other."""
    origin = docs.kept.Origin(
        commit="c", versions="v", machine="m", rounding=docs.kept.rounding_id()
    )

    def result(value: float | None, outcome: str = "completed") -> Result:
        return Result(key="run", outcome=outcome, reason="", numbers={"x_m": value, "lost_s": 3.0})

    kept = docs.kept.KeptRun(
        origin=origin, case="", seed=0, result=docs.kept.rounded("run", result(before))
    )
    assert (docs.kept.difference(kept, result(now)) == "") is is_same
    ended = docs.kept.difference(kept, result(before, "diverged"))
    assert ended == "kept completed, now diverged"


def test_results_are_of_this_code_by_commit_and_versions(docs: SimpleNamespace) -> None:
    """Another machine has the same code."""
    here = docs.kept.Origin.here()
    assert replace(here, machine="another", rounding="another").is_of_this_code
    assert not replace(here, commit=OTHER_COMMIT).is_of_this_code
    assert not replace(here, versions="another").is_of_this_code


def test_cells_are_of_completed_runs(docs: SimpleNamespace) -> None:
    """In their unit, over all seeds; a cell of a grid is that of its own run, empty without one."""
    program = docs.table_rows_and_cells

    def result(outcome: str, rms_m: float) -> Result:
        return Result(
            key="",
            outcome=outcome,
            reason="",
            numbers={"rms_m": rms_m, "cost_mean": 2.0, "lost_s": 7.25},
        )

    flown = [result("completed", 0.02), result("completed", 0.04), result("diverged", 9.0)]
    lost, collided = [result("diverged", 9.0)], [result("collided", 9.0)]
    centimetres = program.cell("rms_m", "{:.1f} cm", 100.0)
    assert [centimetres(runs) for runs in (flown, lost)] == ["3.0 cm", ""]
    assert program.cell("rms_m", "{:.1f} cm", 100.0, max)(flown) == "4.0 cm"
    assert program.cell("cost_mean")(flown) == "2.00"
    assert program.completed(flown) == "2 of 3"
    assert program.interval("rms_m", 2, 100.0)(flown).startswith("3.00")
    ends = [program.outcome(runs) for runs in (flown, lost, collided)]
    assert ends == ["completes", "**diverges** at 7.2 s", "**is collided** at 7.2 s"]
    both = program.unless_diverged(centimetres, program.cell("cost_mean"))
    assert [both(flown[:1]), both(lost)] == ["2.0 cm, 2.00", "**diverges** at 7.2 s"]

    shown = program.grid("a grid", [""], ["one", "other"], {"row": []}, centimetres)
    one, other = shown.columns.values()
    assert [one(flown, None), other(flown, None)] == ["3.0 cm", ""]


def test_rows_share_runs_and_say_what_they_are(docs: SimpleNamespace) -> None:
    """A run of two rows is simulated once, with each of its seeds; a cell may have none. Zero is a number."""
    program = docs.table_rows_and_cells
    one = program.Run("paper", ("seed=1",))
    two = program.Run("paper", ("links.loss=0.5",), uavs=3, seeds=2)
    assert (one.point().team, two.point().team) == (None, (3, 1))

    def result(cost: float | None) -> Result:
        return Result(key="", outcome="completed", reason="", numbers={"cost_mean": cost})

    def mean(flown: Any) -> str:
        return f"{sum(program.values('cost_mean', flown)):g} of {len(program.values('cost_mean', flown))}"

    rows = {"ab": [one, None], ("b", "c"): [two, one]}
    shown = program.grid("shared", ["row", "part"], ["first", "second"], rows, mean)
    table = program.measured("page.md", shown)
    assert len(table.cases) == 3
    assert table.texts == ["paper: seed=1", "paper: links.loss=0.5", "paper: links.loss=0.5"]
    text = table.text([result(5.0), result(0.0), result(None)]).splitlines()
    assert text[2:] == ["| ab | 5 of 1 | |", "| b | c | 0 of 1 | 5 of 1 |"]


def test_further_numbers_are_those_of_the_last_tick(
    docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the UAV that is farthest from its reference; cables and walls are those of a run that has some."""
    program = docs.table_rows_and_cells
    errors_m = np.zeros((3, 2, 3))
    errors_m[0] = 9.0
    errors_m[-1, 1] = [3.0, 0.0, 4.0]
    monkeypatch.setattr(program, "series_of", lambda *_: SimpleNamespace(uav_errors_I=errors_m))
    for cables, walls in ((None, None), ({"slack": 1}, {"uav": 0.5})):
        summary = {"cables": cables, "clearance_min_m": walls}
        expected = {"uav_last_m": 5.0, **(cables or {}), **(walls or {})}
        assert program.more(None, summary, None) == expected


@pytest.mark.usefixtures("docs")
def test_settings_are_those_of_the_words_of_a_row() -> None:
    """Delays and losses that a row names."""
    tables = import_module("measured_controllers"), import_module("measured_results")
    known = {
        "200 ms": "links.delay_s=0.2",
        "30 % packet loss": "links.loss=0.3",
        "100 ms": "links.delay_s=0.1",
    }
    count = 0
    for one in (*tables[0].ENGINES, *tables[0].VALUES, *tables[1].RESULTS):
        for key, runs in one.rows.items():
            for words, setting in known.items():
                if words in " ".join([key] if isinstance(key, str) else key):
                    assert all(setting in run.settings for run in runs)
                    count += 1
    assert count >= 10


def test_a_run_that_this_machine_cannot_repeat_is_not_drawn(
    docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the firmware, an extra of its own, only runs with the modelled inner loop are drawn."""
    one = docs.figures.TABLES["firmware"]()

    def draws() -> set[str]:
        tasks = [docs.figures.drawn(one, seed)[0] for seed in range(30)]
        return {task.case.scenario.plant.inner_loop for task in tasks}

    monkeypatch.setattr(docs.figures, "find_spec", lambda _: None)
    assert draws() == {"model"}
    monkeypatch.setattr(docs.figures, "find_spec", lambda _: "found")
    assert draws() == {"model", "betaflight"}


def test_a_changed_digit_of_a_page_is_told(docs: SimpleNamespace, short: Any) -> None:
    """A page with one other digit differs from the kept results."""
    change_a_digit(short.document)
    assert docs.figures.problems_of_pages([short]) == [
        "short: page.md differs from the kept results"
    ]


def test_a_changed_kept_digit_is_told(docs: SimpleNamespace, short: Any) -> None:
    """A kept result whose first digits differ from those of the repeated run is told.

    Its page differs, and if that is written again, the changed run where it is drawn.
    """
    file = docs.kept.file_of("short")
    runs = docs.kept.read(file)
    changed = next(iter(runs.values()))
    changed.result.numbers["cost_mean"] *= 1.01
    docs.kept.write(file, runs.values())
    assert len(docs.figures.problems_of_pages([short])) == 1

    docs.figures.put(short.document, "short", docs.figures.text_of(short, runs))
    assert docs.figures.problems_of_pages([short]) == []

    seeds = {docs.figures.drawn(short, seed)[0].text: seed for seed in range(9)}
    (problem,) = docs.figures.problems_of_drawn([short], seeds.pop(changed.case))
    assert problem.startswith(f"short: {changed.case}, seed 0: cost_mean: kept ")
    (other,) = seeds.values()
    assert docs.figures.problems_of_drawn([short], other) == []


def test_a_changed_weight_of_a_scenario_is_told(
    docs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table of the docs whose scenario has one other weight is of other scenarios; nothing flies."""

    def changed(name: str) -> Path:
        text = find_scenario(name).read_text()
        before = "attitude = 5.0"
        if name == "paper":
            assert before in text
        file = tmp_path / f"{name}.toml"
        file.write_text(text.replace(before, "attitude = 5.001"))
        return file

    assert docs.figures.problems_of_pages([docs.figures.TABLES[TABLE]()]) == []
    monkeypatch.setattr("transport.experiments.cases.find_scenario", changed)
    (problem,) = docs.figures.problems_of_pages([docs.figures.TABLES[TABLE]()])
    assert problem.startswith(f"{TABLE}: ")
    assert problem.endswith("of other scenarios")


def test_kept_results_read_back(docs: SimpleNamespace, short: Any) -> None:
    """Results are the same after writing and reading; only what is missing is simulated."""
    runs = docs.kept.read(docs.kept.file_of("short"))
    docs.kept.write(docs.kept.file_of("again"), runs.values())
    assert docs.kept.read(docs.kept.file_of("again")) == runs
    assert docs.figures.missing(short, runs) == []
    first, *_ = runs
    del runs[first]
    (task,) = docs.figures.missing(short, runs)
    assert docs.kept.run_id(task.case.scenario) == first


def test_only_times_may_differ(docs: SimpleNamespace, short: Any) -> None:
    """Processor times may differ, other numbers within 2e-5, which other kernels change.

    Times of divergence are equal on the same machine, and within a factor of 1.4 on another.
    """

    def differs(kept_run: Any, result: Result, **numbers: float) -> bool:
        repeated = replace(result, numbers={**result.numbers, **numbers})
        return bool(docs.kept.difference(kept_run, repeated))

    case = short.cases[0]
    completed = replace(simulate(case), numbers={"lost_s": None, "cost_mean": 5.0, "cpu_ms": 1.0})
    kept_run = docs.kept.kept_run(case, "", completed)
    assert not differs(kept_run, completed, cpu_ms=2.0)
    for sign in (-1.0, 1.0):
        assert not differs(kept_run, completed, cost_mean=5.0 * (1.0 + sign * 1.5e-5))
        assert differs(kept_run, completed, cost_mean=5.0 * (1.0 + sign * 3e-5))

    diverged = replace(completed, outcome="diverged", numbers={"lost_s": 5.5})
    here = docs.kept.kept_run(case, "", diverged)
    assert differs(here, diverged, lost_s=6.4)
    elsewhere = replace(here, origin=replace(here.origin, rounding="another"))
    assert not differs(elsewhere, diverged, lost_s=6.4)
    assert differs(elsewhere, diverged, lost_s=9.0)


def test_results_of_other_code_are_known(docs: SimpleNamespace, short: Any) -> None:
    """Runs of other commits are missing only if asked for."""
    runs = docs.kept.read(docs.kept.file_of("short"))
    assert docs.figures.missing(short, runs, of_this_code=True) == []

    first, second = runs
    runs[second] = of_other_code(runs[second])
    assert docs.figures.missing(short, runs) == []
    (task,) = docs.figures.missing(short, runs, of_this_code=True)
    assert docs.kept.run_id(task.case.scenario) == second

    runs[first] = of_other_code(runs[first])
    assert len(docs.figures.missing(short, runs, of_this_code=True)) == 2


def test_a_check_reports_each_table_once(docs: SimpleNamespace, alone: Any) -> None:
    """Pages are compared, then a drawn run of each table whose page is right."""
    assert docs.figures.check(["short"], 0) == []

    file = docs.kept.file_of("short")
    runs = docs.kept.read(file)
    for run in runs.values():
        run.result.numbers["cost_mean"] *= 1.01
    docs.kept.write(file, runs.values())
    (problem,) = docs.figures.check(["short"], 0)
    assert problem == "short: page.md differs from the kept results"

    docs.figures.put(alone.document, "short", docs.figures.text_of(alone, runs))
    (problem,) = docs.figures.check(["short"], 0)
    assert "cost_mean: kept " in problem


def test_the_drawn_runs_change_with_results_and_code(
    docs: SimpleNamespace, short: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The seed is the same as long as the kept results and the commit of the simulation are."""
    assert short.name == "short"
    seed = docs.figures.default_seed()
    assert docs.figures.default_seed() == seed
    here = docs.kept.Origin.here()
    with monkeypatch.context() as other:
        other.setattr(docs.kept.Origin, "here", lambda: replace(here, commit=OTHER_COMMIT))
        assert docs.figures.default_seed() != seed
    file = docs.kept.file_of("short")
    file.write_text(file.read_text(encoding="utf-8") + "# more: {}\n", encoding="utf-8")
    assert docs.figures.default_seed() != seed


def test_renewal_simulates_nothing_that_is_kept(
    docs: SimpleNamespace, alone: Any, simulated: list[str]
) -> None:
    """The page is written from results of this code, without a run."""
    before = alone.document.read_text()
    change_a_digit(alone.document)
    renew(docs, of_this_code=True)
    assert alone.document.read_text() == before
    assert simulated == []


@pytest.mark.parametrize(
    ("factor", "of_this_code", "runs"), [(1.0, False, 1), (1.01, False, 3), (1.0, True, 2)]
)
def test_renewal_of_results_of_other_code(
    docs: SimpleNamespace,
    alone: Any,
    simulated: list[str],
    factor: float,
    *,
    of_this_code: bool,
    runs: int,
) -> None:
    """A drawn run decides whether all are simulated again; `--all-runs` asks for all at once."""
    before = alone.document.read_text()
    file = docs.kept.file_of("short")
    kept_runs = {run: of_other_code(kept) for run, kept in docs.kept.read(file).items()}
    for kept in kept_runs.values():
        kept.result.numbers["cost_mean"] *= factor
    docs.kept.write(file, kept_runs.values())

    renew(docs, of_this_code=of_this_code)
    assert len(simulated) == runs
    assert alone.document.read_text() == before
    is_renewed = runs > 1
    commits = {kept.origin.commit for kept in docs.kept.read(file).values()}
    assert (OTHER_COMMIT not in commits) == is_renewed


def test_the_archive_repeats_runs(
    docs: SimpleNamespace, short: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scenario file of the archive has the fingerprint in its name, and is one that can run."""
    archive = import_module("archive")
    monkeypatch.setitem(docs.figures.TABLES, "short", lambda: short)
    archive.write(tmp_path / "runs.zip", ["short"])
    with zipfile.ZipFile(tmp_path / "runs.zip") as written:
        written.extractall(tmp_path)
    files = sorted((tmp_path / "scenarios").glob("*.toml"))
    assert {file.stem for file in files} == docs.kept.read(docs.kept.file_of("short")).keys()
    for file in files:
        assert docs.kept.run_id(read_scenario(file)) == file.stem


def test_each_table_has_its_own_name(docs: SimpleNamespace) -> None:
    """No two tables have the same kept results."""
    pages = import_module("measured_pages").PAGES
    names = [one.name for tables in pages.values() for one in tables]
    names += import_module("results_page").EXPERIMENTS
    assert sorted(names) == sorted(docs.figures.TABLES)


@pytest.mark.parametrize(
    ("completed", "runs", "text"),
    [
        (60, 60, "60 of 60 (94 to 100 %)"),  # 0.025 ** (1 / 60) = 0.940
        (0, 10, "0 of 10 (0 to 31 %)"),  # 1 - 0.025 ** (1 / 10) = 0.308
        (5, 10, "5 of 10 (19 to 81 %)"),  # table of Clopper and Pearson
    ],
)
def test_counts_have_the_exact_interval(
    docs: SimpleNamespace, completed: int, runs: int, text: str
) -> None:
    """The ends are the shares at which so many, or so few, completed runs have the probability 2.5 %."""
    assert import_module("tables").completed_of(completed, runs) == text


@pytest.mark.parametrize(
    ("costs", "text"),
    [
        ((1.0, 1.05, 0.95), "**1.050, 0.950**"),
        ((2.0, 2.004, 1.9), "1.002, 0.950"),  # not worse: within half a percent
        ((1.0, 1.2, 0.95), "1.200, 0.950"),  # worse by more than a tenth
        ((1.0, 1.05, 1.01), "1.050, 1.010"),  # not better at the same computation
        ((1.0, None, 0.95), "diverges, 0.950"),
    ],
)
def test_a_point_of_the_claims_is_bold_where_both_hold(
    docs: SimpleNamespace, costs: tuple[float | None, ...], text: str
) -> None:
    """Slightly worse at the same rate, and slightly better at the same computation; the second horizon's runs."""
    runs = [(3.0, 3.0, 3.0), costs]
    results = [
        [Result(key="", outcome="diverged" if cost is None else "completed", reason="", numbers={"cost_mean": cost})]
        for of_horizon in runs
        for cost in of_horizon
    ]  # fmt: skip
    assert import_module("measured_results").ratios(1, *results) == text


def test_effects_at_a_glance_are_ranges_of_the_points(docs: SimpleNamespace) -> None:
    """Counts and ranges are over all points with the labels; the baseline, which no agent leaves, is none of them."""
    effect_of = import_module("derived_tables").effect_of

    def point(agent: str, completed: int, cost: str, attitude: str, first_s: str) -> dict[str, str]:
        return {
            "scenario": "paper",
            "agent": agent,
            "flights": "2",
            "completed": str(completed),
            "cost_ratio": cost,
            "attitude_max_deg": attitude,
            "swing_m": "0.25",
            "first_lost_s": first_s,
        }

    rows = [
        point("none", 2, "1.0", "0.5", ""),
        point("1", 2, "1.5", "3.0", ""),
        point("2", 1, "2.25", "8.04", "7.0"),
        point("3", 0, "", "", "4.25"),
    ]
    expected = "3 of 6 complete: cost x1.50 to 2.25, attitude 8.0 deg, swing 0.25 m"
    assert effect_of(rows, {"scenario": "paper"}) == expected
    lost = effect_of(rows[3:], {"scenario": "paper"})
    assert lost == "0 of 2 complete, the first diverges at 4.2 s"
    assert effect_of(rows, {"scenario": "resilient"}) == ""


@pytest.mark.usefixtures("docs")
def test_cells_of_experiments_are_those_of_their_files() -> None:
    """A number that is zero is told, an absent one is empty."""
    row = {"delay_s": 0.0, "seed": 0, "lost_s": None, "outcome": "completed"}
    told = import_module("results_page")._as_text(row)
    assert told == {"delay_s": "0.0", "seed": "0", "lost_s": "", "outcome": "completed"}
