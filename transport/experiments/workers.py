"""Workers that simulate the cases of an experiment: processes of this machine, or a Dask cluster.

Results come in any order. Worker processes end with the generator, also after an error.
"""

import importlib.util
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

from transport.experiments.cases import Case, ExperimentError, refused
from transport.experiments.simulation import Result, simulate
from transport.protocol.scenario.sections.limits_on_size import most_workers
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE

Item = TypeVar("Item")
Value = TypeVar("Value")

# Time within which the scheduler must answer the connection, s.
_ANSWER_S = 15.0
# Period at which a worker checks that its parent lives, s.
_CHECK_S = 0.5


def on_cores(cases: Sequence[Case], jobs: int | None = None) -> Iterator[Result]:
    """Simulate cases on this machine, by default as many at a time as cores and memory allow.

    Raises: ExperimentError: a worker process has died.
    """
    import joblib

    most = jobs or min(joblib.cpu_count(), most_workers(case.scenario for case in cases))
    return map_on_cores(simulate, cases, most)


def map_on_cores(
    function: Callable[[Item], Value], items: Sequence[Item], jobs: int | None = None
) -> Iterator[Value]:
    """Apply a function to items in worker processes, in any order; with one job in this process.

    Args:
        function: Picklable; returns one result.
        items: Its arguments.
        jobs: Most workers; by default one for each core.

    Raises: ExperimentError: a worker process has died.
    """
    import joblib

    cores = joblib.cpu_count()
    with Workers(min(len(items), jobs or cores)) as workers:
        yield from workers.map(function, items)


class Workers:
    """Worker processes that stay from one batch of items to the next, and end with the block."""

    def __init__(self, jobs: int | None = None) -> None:
        """Args: jobs: Workers; by default one for each core. A single job is this process."""
        import joblib

        self.jobs = jobs or joblib.cpu_count()
        self._starting: Iterator[None] | None = None  # calls by which the processes start
        self._have_begun = False

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        if self.jobs > 1:
            from joblib.externals.loky import get_reusable_executor
            from joblib.externals.loky.process_executor import TerminatedWorkerError

            with suppress(TerminatedWorkerError):
                self._wait_for_start()
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)

    def map(self, function: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Value]:
        """Apply a function to items, in any order; the processes start with the first call.

        A single item is computed in this process, while those start.

        Args:
            function: Picklable; returns one result.
            items: Its arguments.

        Raises: ExperimentError: a worker process has died.
        """
        if self.jobs <= 1:
            yield from map(function, items)
            return
        if len(items) <= 1:
            if not self._have_begun:
                self._starting = self._apply(_imported, [function] * self.jobs)
                self._have_begun = True
            yield from map(function, items)
            return
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        try:
            self._wait_for_start()
            self._have_begun = True
            yield from self._apply(function, items)
        except TerminatedWorkerError as error:
            line = str(error).splitlines()[0]
            raise ExperimentError(f"a worker process died: {line}", EXIT_UNREACHABLE) from error

    def _wait_for_start(self) -> None:
        """Wait for the calls by which the processes start; joblib warns of calls that are given up."""
        if self._starting is not None:
            deque(self._starting, maxlen=0)
            self._starting = None

    def _apply(self, function: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Value]:
        """Begin to apply a function in the processes; return the results, in any order."""
        import joblib

        # Not loky alone: with all items in its queue its thread may raise while workers are killed.
        team = joblib.Parallel(
            n_jobs=self.jobs, return_as="generator_unordered", batch_size=1, max_nbytes=None,
            initializer=_prepare_worker, initargs=(os.getpid(),),
        )  # fmt: skip
        results: Iterator[Value] = team(joblib.delayed(function)(item) for item in items)
        return results


def check_cluster(address: str) -> None:
    """Check the address of a cluster, without connecting.

    Raises: ExperimentError: not an address, or the package distributed is missing.
    """
    if "://" not in address:
        raise refused("--dask", "an address such as tcp://host:8786", repr(address))
    if importlib.util.find_spec("distributed") is None:
        expected = "the package distributed (pip install 'payload-transport[cluster]')"
        raise refused("--dask", expected, "none")


def on_cluster(cases: Sequence[Case], address: str) -> Iterator[Result]:
    """Simulate cases on a Dask cluster; the cases of a worker that dies are repeated by the others.

    Raises: ExperimentError: no cluster, one without suitable workers, or one that fails.
    """
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout=_ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        expected = f"a scheduler at {address}"
        got = f"no answer ({error})"
        raise refused("--dask", expected, got, EXIT_UNREACHABLE) from error

    with client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        _check_threads(address, [worker["nthreads"] for worker in workers])

        futures = [client.submit(simulate, case, pure=False) for case in cases]
        for future in as_completed(futures, loop=client.loop):
            if future.status != "finished":
                problem = f"the cluster at {address} fails: {future.exception()}"
                raise ExperimentError(f"--dask: {problem}", EXIT_UNREACHABLE)
            yield future.result()


def _check_threads(address: str, threads: Sequence[int]) -> None:
    """Refuse a cluster without workers, or with a worker of several threads.

    Raises: ExperimentError.
    """
    if threads and max(threads) <= 1:
        return
    expected = f"workers with one thread each at {address} (dask worker {address} --nthreads 1)"
    got = f"some with {max(threads)}" if threads else "none"
    raise refused("--dask", expected, got, EXIT_UNREACHABLE)


def _imported(_function: Callable[[Item], Value]) -> None:
    """Do nothing: a worker has imported what a function needs when it has received it."""


def _prepare_worker(parent: int) -> None:
    """Prepare a worker: ignore Ctrl-C, which the parent handles, and end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(_CHECK_S)
        os._exit(EXIT_UNREACHABLE)

    threading.Thread(target=end_with_parent, daemon=True).start()
