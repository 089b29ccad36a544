"""Tables of documents against their kept results: what is not today's is told."""

import zipfile
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from transport.experiments.cases import simulate
from transport.protocol.scenario.file import find_scenario, read_scenario

ROOT = Path(__file__).resolve().parent.parent
SHORT = ("maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.1]}]",)
# A table of any page whose runs are read within a tenth of a second.
TABLE = "negotiation_iterations"


@pytest.fixture
def docs(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The modules of the folder docs."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    names = ("figures", "fingerprint", "kept", "simulations")
    return SimpleNamespace(**{name: import_module(name) for name in names})


@pytest.fixture
def short(docs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A table of two short runs with its page and its kept results."""
    monkeypatch.setattr(docs.kept, "FOLDER", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("<!-- short -->\n\n<!-- end of short -->\n")
    runs = {
        "paper": docs.simulations.Run("paper", SHORT),
        "late": docs.simulations.Run("paper", (*SHORT, "links.delay_s=0.2")),
    }
    columns = {"result": docs.simulations.outcome, "cost": docs.simulations.COST}
    table = docs.simulations.listed("short", "", runs, columns)
    # In this process: worker processes take seconds to start.
    one = replace(docs.simulations.measured("time.md", table), document=page, is_timed=True)
    kept_runs = docs.figures.complete(one, docs.figures.missing(one, {}))
    docs.figures.put(page, "short", docs.figures.text_of(one, kept_runs))
    return one


def test_a_renewed_table_is_right(docs: SimpleNamespace, short: Any) -> None:
    """The page equals the kept results, and each of the runs, repeated, has their numbers."""
    assert docs.figures.problems_of_pages([short]) == []
    for seed in range(3):
        assert docs.figures.problems_of_drawn([short], seed) == []
    draws = {docs.figures.drawn(short, seed).text for seed in range(9)}
    assert len(draws) == 2


def test_a_run_that_this_machine_cannot_repeat_is_not_drawn(
    docs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the firmware, an extra of its own, only runs with the modelled inner loop are drawn."""
    one = docs.figures.TABLES["firmware"]()

    def draws() -> set[str]:
        tasks = [docs.figures.drawn(one, seed) for seed in range(30)]
        return {task.case.scenario.plant.inner_loop for task in tasks}

    monkeypatch.setattr(docs.figures, "firmware_version", lambda: "")
    assert draws() == {"model"}
    monkeypatch.setattr(docs.figures, "firmware_version", lambda: "0.0.6")
    assert draws() == {"model", "betaflight"}


def test_a_changed_digit_of_a_page_is_told(docs: SimpleNamespace, short: Any) -> None:
    """A page with one other digit differs from the kept results."""
    text = short.document.read_text()
    digit = max(i for i, letter in enumerate(text) if letter.isdigit())
    other = str((int(text[digit]) + 1) % 10)
    short.document.write_text(text[:digit] + other + text[digit + 1 :])
    assert docs.figures.problems_of_pages([short]) == [
        "short: page.md differs from the kept results"
    ]


def test_a_changed_kept_digit_is_told(docs: SimpleNamespace, short: Any) -> None:
    """A kept result whose first digits differ from those of the repeated run is told.

    Its page differs, and if that is written again, the run that is drawn.
    """
    file = docs.kept.file_of("short")
    runs = docs.kept.read(file)
    for run in runs.values():
        run.result.numbers["cost_mean"] *= 1.001
    docs.kept.write(file, runs.values())
    assert len(docs.figures.problems_of_pages([short])) == 1

    docs.figures.put(short.document, "short", docs.figures.text_of(short, runs))
    assert docs.figures.problems_of_pages([short]) == []
    (problem,) = docs.figures.problems_of_drawn([short], 0)
    assert problem.startswith("short: paper: ")
    assert "cost_mean: kept " in problem


def test_a_changed_weight_of_a_scenario_is_told(
    docs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table of the docs whose scenario has one other weight is of other scenarios; nothing flies."""

    def changed(name: str) -> Path:
        text = find_scenario(name).read_text()
        before = "attitude = 5.0"
        assert name not in {"paper"} or before in text
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
    assert not docs.figures.is_of_other_code(short, runs)
    first, *_ = runs
    del runs[first]
    (task,) = docs.figures.missing(short, runs)
    assert docs.fingerprint.run_id(task.case.scenario) == first


def test_only_times_may_differ(docs: SimpleNamespace, short: Any) -> None:
    """Processor times are not compared, numbers are, and a time of divergence within bounds.

    On the same machine that time is compared as well.
    """
    case = short.cases[0]
    result = replace(simulate(case), numbers={"lost_s": None, "cost_mean": 1.0, "cpu_ms": 1.0})
    kept_run = docs.kept.kept_run(case, "", result)

    def differs(**numbers: float) -> bool:
        changed = replace(result, numbers={**result.numbers, **numbers})
        return bool(docs.kept.difference(kept_run, changed))

    assert not differs(cpu_ms=2.0)
    assert not differs(cost_mean=1.000004)
    assert differs(cost_mean=1.0001)

    diverged = replace(result, outcome="diverged", numbers={"lost_s": 5.5})
    kept_run = docs.kept.kept_run(case, "", diverged)
    result = diverged
    assert differs(lost_s=6.4)
    elsewhere = replace(kept_run.origin, rounding="another")
    kept_run = replace(kept_run, origin=elsewhere)
    assert not differs(lost_s=6.4)
    assert differs(lost_s=9.0)


@pytest.mark.parametrize(
    ("after", "is_same"),
    [
        (
            '"""Other words."""\n\ndef f(x):  # why\n    """One.\n\n    Two."""\n    return x\n',
            True,
        ),
        ("def f(x):\n    return  x\n", False),
        ("def f(x):\n    return x + 1\n", False),
        ('def f(x):\n    return "# no comment" + x\n', False),
    ],
)
def test_only_what_computes_changes_the_code(
    docs: SimpleNamespace, after: str, *, is_same: bool
) -> None:
    """Comments, docstrings and empty lines do not change the fingerprint; all else does."""
    essential: Callable[[str], str] = docs.fingerprint.essential
    before = 'def f(x):\n    """Ä."""\n    return x\n'
    assert (essential(before) == essential(after)) == is_same


def test_texts_that_compute_stay(docs: SimpleNamespace) -> None:
    """Texts that are no docstrings stay, with what is within them."""
    source = 'x = "# a"  # b\ny = """c\n# d\n"""\n'
    assert docs.fingerprint.essential(source) == 'x = "# a"\ny = """c\n# d\n"""'


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
        assert docs.fingerprint.run_id(read_scenario(file)) == file.stem


def test_each_table_has_its_own_name(docs: SimpleNamespace) -> None:
    """No two tables have the same kept results."""
    pages = import_module("measured_pages").PAGES
    names = [one.name for tables in pages.values() for one in tables]
    names += import_module("results_page").EXPERIMENTS
    assert sorted(names) == sorted(docs.figures.TABLES)
