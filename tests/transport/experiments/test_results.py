"""The folder of an experiment.

Kept results survive, damage is told, other people's folders are left alone.
"""

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import orjson
import pytest
from rich.console import Console

from transport.experiments.cases import Case, ExperimentError, Point, cases_of
from transport.experiments.declaration import Experiment
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.experiments.sweep import Results, Swept, sweep
from transport.protocol.wire.errors_and_exit_codes import EXIT_FAILED, EXIT_USAGE


def result(key: str, outcome: str = "completed", cost: float = 0.1 + 0.2) -> Result:
    """Return the result of a run."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS)
    return Result(key=key, outcome=outcome, reason="", numbers=numbers | {"cost_mean": cost})


def opened(folder: Path, experiment: str = "latency") -> Results:
    """The folder of an experiment."""
    return Results(experiment, folder)


def test_results_are_read_back_as_the_same_bits(tmp_path: Path) -> None:
    """Added results are there when the folder is opened again."""
    with opened(tmp_path / "new" / "out") as results:
        results.add(result("a"))
        results.add(result("b", ERROR))
    with opened(tmp_path / "new" / "out") as results:
        assert results["a"] == result("a")
        assert (results.done("a"), results.done("b"), results.done("c")) == (True, False, False)


@pytest.mark.parametrize("left", [1, 20])
def test_an_incomplete_line_is_ignored(tmp_path: Path, left: int) -> None:
    """A last line cut anywhere loses its own result only, and does not affect the next line."""
    with opened(tmp_path) as results:
        results.add(result("a"))
        results.add(result("b"))
    path = tmp_path / "results.jsonl"
    first, second = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + second[:left])
    for added in ("c", "d"):
        with opened(tmp_path) as results:
            assert (results.done("a"), results.done("b"), results.done("c")) == (
                True,
                False,
                added == "d",
            )
            results.add(result(added))


def test_lines_of_other_types_are_ignored(tmp_path: Path) -> None:
    """A value of another type, at any place, is no result: its case is simulated again."""
    with opened(tmp_path) as results:
        results.add(result("a"))
    path = tmp_path / "results.jsonl"
    tree = orjson.loads(path.read_bytes())
    wrong = [{**tree, name: value} for name in tree for value in (1, [1], None, True, {"x": "y"})]
    wrong += [{**tree, "numbers": {**tree["numbers"], "cost_mean": value}} for value in ("1", [1])]
    others = [b"[1]", b"1", b"null", b"\xff", b'{"key": "a"}']
    path.write_bytes(b"\n".join([*others, *map(orjson.dumps, wrong)]) + b"\n")
    with opened(tmp_path) as results:
        assert not results.done("a")
        results.add(result("a"))
    with opened(tmp_path) as results:
        assert results["a"] == result("a")


def test_a_result_without_all_numbers_is_ignored(tmp_path: Path) -> None:
    """It is one of an earlier version, and simulated again; an error has none, and is told until then."""
    whole = result("a")
    numbers = {name: whole.numbers[name] for name in NUMBERS[1:]}
    with opened(tmp_path) as results:
        results.add(Result(key="a", outcome="completed", reason="", numbers=numbers))
        results.add(Result(key="b", outcome=ERROR, reason="why", numbers={}))
    with opened(tmp_path) as results:
        assert ("a" in results, "b" in results) == (False, True)
        assert results.earlier == frozenset()


def test_a_sweep_simulates_what_is_missing_seed_by_seed(tmp_path: Path) -> None:
    """Once each, in the order of the seeds; results have the order of the cases, and errors are simulated again."""
    points = [
        Point({"loss": share}, "", (f"links.loss={share}",), scenario="paper")
        for share in (0.1, 0.2)
    ]
    cases = cases_of(points, (), 3)
    simulated: list[tuple[int, int]] = []

    def simulate(missing: Sequence[Case]) -> Iterator[Result]:
        for case in missing:
            simulated.append((case.point, case.scenario.seed))
            one = result(case.key, cost=case.point + 0.1 * case.scenario.seed)
            yield replace(one, reason=f"{case.point}")

    experiment = Experiment(name="test", points=tuple(points))
    with opened(tmp_path, "test") as results:
        results.add(result(cases[1].key))
        results.add(result(cases[3].key, ERROR))
        output = io.StringIO()
        console = Console(file=output, width=200)
        swept = sweep(experiment, [*cases, cases[0]], simulate, results, console)
    # None was in the folder before; those that had a result are done.
    assert (
        output.getvalue().splitlines()[-1] == "6 of 6 runs done; last: paper, , seed 2: completed"
    )
    assert "already" not in output.getvalue()
    assert [row["reason"] for row in swept.rows("runs")] == ["0", "", "0", *["1"] * 3, "0"]
    assert simulated == [(0, 0), (1, 0), (1, 1), (0, 2), (1, 2)]
    costs = [one.numbers["cost_mean"] for one in swept.results]
    assert costs == pytest.approx([0.0, 0.3, 0.2, 1.0, 1.1, 1.2, 0.0])
    assert [row["loss"] for row in swept.rows("runs")] == [0.1] * 3 + [0.2] * 3 + [0.1]
    assert "lost_s" in swept.rows("runs")[0]
    assert "lost_s" not in swept.rows("points")[0]  # which has the first of them


def test_a_folder_whose_beginning_a_kill_has_cut_is_used(tmp_path: Path) -> None:
    """A kill while the name of the experiment is written leaves a part of that file, and no results."""
    (tmp_path / "experiment.json.partial").write_text('{"exper', encoding="utf-8")
    with opened(tmp_path, "loss") as results:
        results.add(result("a"))
    with opened(tmp_path, "loss") as results:
        assert results.done("a")


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    """Another experiment's folder, one with other files, and a file are refused with expected and got."""
    expected = "--out: expected a new folder, or one of experiment loss, got"
    with opened(tmp_path / "late"), pytest.raises(ExperimentError, match=expected) as refusal:
        opened(tmp_path / "late", "loss")
    assert str(refusal.value).endswith("late, which contains experiment latency")
    assert refusal.value.exit_code == EXIT_USAGE
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "experiment.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ExperimentError, match="which contains other files"):
        opened(tmp_path / "broken", "latency")
    with pytest.raises(ExperimentError, match="which contains other files"):
        opened(tmp_path / "mine", "loss")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
    with pytest.raises(ExperimentError, match="File exists"):
        opened(tmp_path / "mine" / "thesis.tex", "loss")


@pytest.mark.parametrize(
    ("reasons", "text"),
    [([], ""), (["why"], "a run raised an error: why"), (["why", "x", "y"], "a run raised an error (and 2 more): why")],
)  # fmt: skip
def test_a_sweep_with_errors_is_refused_by_the_first(reasons: list[str], text: str) -> None:
    """Diverged runs are results; with an error the exit code tells that a run failed."""
    failed = [Result(key="k", outcome=ERROR, reason=reason, numbers={}) for reason in reasons]
    swept = Swept(
        experiment=Experiment(name="test"), cases=[], results=[result("a", "diverged"), *failed]
    )
    if not reasons:
        swept.check()
        return
    with pytest.raises(ExperimentError) as refusal:
        swept.check()
    assert (str(refusal.value), refusal.value.exit_code) == (text, EXIT_FAILED)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ExperimentError("a worker process died")])
def test_an_interrupted_sweep_tells_how_to_resume(tmp_path: Path, error: BaseException) -> None:
    """With a folder: how many runs are saved there, without counting errors; without one there is nothing to tell."""
    point = Point({"loss": 0.1}, "", ("links.loss=0.1",), scenario="paper")
    cases = cases_of([point], (), 3)

    def interrupted(missing: Sequence[Case]) -> Iterator[Result]:
        yield result(missing[0].key)
        yield result(missing[1].key, ERROR)
        raise error

    for folder in (tmp_path, None):
        output = io.StringIO()
        experiment = Experiment(name="test", points=(point,))
        with Results("test", folder) as results, pytest.raises(type(error)):
            sweep(experiment, cases, interrupted, results, Console(file=output, width=200))
        hint = f"1 of 3 runs are saved; resume with: --out {folder}"
        assert (hint in output.getvalue()) == (folder is not None)
        assert ("are saved" in output.getvalue()) == (folder is not None)
