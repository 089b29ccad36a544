"""Workers of a sweep without processes or a cluster: how many there are, who computes, and which cluster is refused."""

import sys
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import joblib
import pytest
from joblib.externals.loky.process_executor import TerminatedWorkerError

from transport.experiments import workers
from transport.experiments.cases import ExperimentError
from transport.experiments.workers import Workers, check_cluster, map_on_cores, on_cluster, on_cores
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE, EXIT_USAGE

CORES = 8


@pytest.mark.parametrize(
    ("cases", "jobs", "fitting", "used"),
    [
        (20, None, 99, CORES),
        (20, None, 5, 5),  # as many as the memory holds
        (20, 12, 5, 12),  # as asked for
        (3, None, 99, 3),
        (1, 4, 99, 1),
    ],
)
def test_there_are_as_many_workers_as_cores_memory_and_cases_allow(
    cases: int, jobs: int | None, fitting: int, used: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless a number is asked for; never more than cases."""
    asked: list[int | None] = []

    class Counted(Workers):
        def __init__(self, jobs: int | None = None) -> None:
            asked.append(jobs)
            super().__init__(1)

    monkeypatch.setattr(joblib, "cpu_count", lambda: CORES)
    monkeypatch.setattr(workers, "most_workers", lambda _: fitting)
    monkeypatch.setattr(workers, "Workers", Counted)
    monkeypatch.setattr(workers, "simulate", lambda case: case)
    given: Any = [SimpleNamespace(scenario=None) for _ in range(cases)]
    assert list(on_cores(given, jobs)) == given
    assert asked == [used]
    assert list(map_on_cores(abs, [-1, 2])) == [1, 2]
    assert asked[1:] == [2]
    assert Workers().jobs == CORES


class Started(Workers):
    """Workers that note what their processes would compute, and compute it here."""

    def __init__(self, jobs: int) -> None:
        super().__init__(jobs)
        self.begun: list[int] = []  # number of items of each call
        self.ended = 0

    def _apply(self, function: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[Any]:
        self.begun.append(len(items))

        def results() -> Iterator[Any]:
            yield from map(function, items)
            self.ended += 1

        return results()


def test_a_single_item_is_computed_here_while_the_processes_start() -> None:
    """They start once, with a call for each; a batch waits for them. A single worker is this process."""
    team = Started(4)
    assert list(team.map(abs, [-1])) == [1]
    assert list(team.map(abs, [-2])) == [2]
    assert (team.begun, team.ended) == ([4], 0)
    assert list(team.map(abs, [-3, 4])) == [3, 4]
    assert (team.begun, team.ended) == ([4, 2], 2)

    alone = Started(1)
    assert list(alone.map(abs, [-1, 2])) == [1, 2]
    assert alone.begun == []


def test_a_worker_that_dies_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exit code is that of a part that cannot be reached."""

    def die(*_: object) -> Iterator[Any]:
        raise TerminatedWorkerError("it was killed\nand a long explanation")

    team = Started(2)
    monkeypatch.setattr(team, "_apply", die)
    with pytest.raises(ExperimentError) as refusal:
        list(team.map(abs, [1, 2]))
    assert str(refusal.value) == "a worker process died: it was killed"
    assert refusal.value.exit_code == EXIT_UNREACHABLE


def test_a_cluster_needs_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The refusal says how to install it; nothing connects."""
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(
        ExperimentError, match="--dask: expected the package distributed"
    ) as refusal:
        check_cluster("tcp://host:8786")
    assert refusal.value.exit_code == EXIT_USAGE


def cluster(threads: Sequence[int], problem: Exception | None) -> ModuleType:
    """Return the package of a cluster whose workers have some threads, perhaps with a problem."""

    class Client:
        loop = None

        def __init__(self, address: str, **options: object) -> None:
            assert (address, options["set_as_default"]) == ("tcp://x:1", False)

        def __enter__(self) -> "Client":
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing is open."""

        def scheduler_info(self, **_: object) -> dict[str, Any]:
            return {"workers": {k: {"nthreads": count} for k, count in enumerate(threads)}}

        def submit(self, function: Callable[[Any], Any], case: Any, *, pure: bool) -> Any:
            assert not pure  # equal cases are simulated each
            return SimpleNamespace(
                status="error" if problem else "finished",
                exception=lambda: problem,
                result=lambda: function(case),
            )

    package = ModuleType("distributed")
    package.Client = Client  # type: ignore[attr-defined]
    package.as_completed = lambda futures, **_: futures  # type: ignore[attr-defined]
    return package


ONE_THREAD = (
    "--dask: expected workers with one thread each at tcp://x:1 "
    "(dask worker tcp://x:1 --nthreads 1)"
)


@pytest.mark.parametrize(
    ("threads", "problem", "text"),
    [
        ([1, 1], None, ""),
        ([], None, f"{ONE_THREAD}, got none"),
        ([1, 4], None, f"{ONE_THREAD}, got some with 4"),
        ([1], ValueError("boom"), "--dask: the cluster at tcp://x:1 fails: boom"),
    ],
)
def test_a_cluster_has_workers_of_one_thread(
    threads: Sequence[int], problem: Exception | None, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums have the same order on every machine; a cluster that fails ends the sweep."""
    monkeypatch.setitem(sys.modules, "distributed", cluster(threads, problem))
    monkeypatch.setattr(workers, "simulate", lambda case: case)
    given: Any = ["a", "b", "a"]
    if not text:
        assert list(on_cluster(given, "tcp://x:1")) == given
        return
    with pytest.raises(ExperimentError) as refusal:
        list(on_cluster(given, "tcp://x:1"))
    assert (str(refusal.value), refusal.value.exit_code) == (text, EXIT_UNREACHABLE)
