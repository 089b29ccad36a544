"""One BLAS thread, as in every process of a run.

How several pytest workers share the tests, and compiled models.
"""

import gc
import importlib
import math
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import scipy.linalg  # noqa: F401 - only libraries that are loaded can be limited
import threadpoolctl

# Ignored in jobs in the background of a shell, and inherited by the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Sums in one order, so that equal inputs give equal bits.
threadpoolctl.threadpool_limits(1)

# The time of one example is the host's affair: another worker is busy.
hypothesis.settings.register_profile("workers", deadline=None)
hypothesis.settings.load_profile("workers")


# Files of tests whose waiting, or computing, takes longest.
FIRST = (
    "test_autopilots",
    "test_soak",
    "test_live_viewer",
    "test_silence",
    "test_agile",
    "test_mujoco",
    "test_worst",
)
# Tests of processes, drivers and pages wait much.
WAITING = ("tests/system/", "tests/vehicle/", "tests/transport/viewer/")
# A test of a minute in real time, mostly waiting: a worker takes it apart from the others of its file.
APART = ("test_each_failure_is_handled",)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options: renew transcripts of runs (tests/transport/flights/test_transcripts.py), end in time."""
    parser.addoption("--rewrite", action="store_true", help="write transcripts of runs anew")
    parser.addoption(
        "--slow-until",
        type=float,
        default=math.inf,
        metavar="TIME",
        help="skip slow tests that would begin after this time, s since 1970",
    )


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a slow test, and the fixtures that it needs, if the time of `--slow-until` is over."""
    is_slow = item.get_closest_marker("slow") is not None
    if is_slow and time.time() > item.config.getoption("--slow-until"):
        pytest.skip("no time left on this machine")


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled models in pytest's cache, for later test runs too.

    The user's is neither read nor filled.

    Kernels and the model of the paper's team are compiled once, before workers start that would all
    do it. Each worker has a register of active runs, so that it finds no run of another.
    """
    register = tempfile.mkdtemp(prefix="payload-transport-tests-")
    os.environ["PAYLOAD_TRANSPORT_ACTIVE"] = register
    config.add_cleanup(lambda: shutil.rmtree(register, ignore_errors=True))
    if not hasattr(config, "workerinput"):
        cache = getattr(config, "cache", None)  # absent with -p no:cacheprovider
        models = f"{register}/models" if cache is None else str(cache.mkdir("models"))
        os.environ["PAYLOAD_TRANSPORT_CACHE"] = models
        from transport.model.kernels import casadi_functions, native  # noqa: F401 - the import compiles

        casadi_functions.compile_functions(4)
        casadi_functions.compile_functions(3)
        casadi_functions.compile_functions(3, rates=True)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Search for no garbage while tests are collected, nor later among what they have made then.

    Collection makes millions of objects that stay: these searches took a third of its time.
    """
    gc.disable()
    try:
        _import_own_share(session.config)
        result = yield
    finally:
        gc.freeze()
        gc.enable()
    return result


def _import_own_share(config: pytest.Config) -> None:
    """Import a worker's share of all files of tests before the others.

    Workers that import the same files at the same time all compile each, and rewrite its assertions: on a
    clean clone half of the time of collection. So each finds most of them compiled by another.
    """
    worker = getattr(config, "workerinput", None)
    is_part = config.option.file_or_dir or str(config.option.markexpr).startswith("slow")
    if worker is None or is_part:
        return
    files = sorted((config.rootpath / "tests").rglob("test_*.py"))
    for file in files[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]:
        name = file.relative_to(config.rootpath).with_suffix("").as_posix().replace("/", ".")
        with suppress(Exception):  # the collection reports it
            importlib.import_module(name)


@pytest.fixture(autouse=True)
def _own_modules_forgotten(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forget modules that a test has imported from its folder, as each user has a process for them."""
    folder = str(tmp_path_factory.getbasetemp())
    newest = next(reversed(sys.modules))
    yield
    # Without a comparison of all modules: 0.2 ms for each of thousands of tests.
    for name in list(takewhile(newest.__ne__, reversed(sys.modules))):
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(folder):
            del sys.modules[name]


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave files without slow tests alone where only slow ones are asked for.

    Importing them takes seconds.
    """
    only_slow = str(config.option.markexpr).startswith("slow")
    return (
        True
        if only_slow
        and collection_path.suffix == ".py"
        and "slow" not in collection_path.read_text()
        else None
    )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Return the scheduler of `--dist loadfile`, with the tests of `APART` by themselves.

    While there are others, one worker computes: where all wait, the processors are idle.
    """
    from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

    class ByFile(LoadFileScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            return nodeid if nodeid.endswith(APART) else super()._split_scope(nodeid)

        def _assign_work_unit(self, node: Any) -> None:
            others = [files for worker, files in self.assigned_work.items() if worker is not node]
            if len(others) > 1 and all(map(is_waiting, others)):
                computing = [file for file in self.workqueue if not file.startswith(WAITING)]
                if computing:
                    self.workqueue.move_to_end(computing[0], last=False)
            super()._assign_work_unit(node)

    def is_waiting(files: dict[str, dict[str, bool]]) -> bool:
        """Return whether a worker has a file of tests that wait, which has not ended."""
        return any(
            file.startswith(WAITING) and not all(are_ended.values())
            for file, are_ended in files.items()
        )

    return ByFile(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.fixture(params=[2, 4, 8])
def vector_width(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Kernels with vectors of each width, in doubles; the compiler divides those wider than a register."""
    from transport.model.kernels import native

    width = int(request.param)
    monkeypatch.setenv("PAYLOAD_TRANSPORT_NATIVE", str(width))
    kernels = native.load()
    assert kernels.vector_width() == width
    monkeypatch.setattr(native, "KERNELS", kernels)
    return width


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put long files first, of which workers take one at a time.

    A long one at the end would leave a worker idle.

    Files whose tests compute for long come behind those of processes, beside which one worker computes.
    Their order is drawn by the time of `--slow-until`, so that a slow machine does not skip the same tests
    each time. Files without slow tests come by their length.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    drawn = random.Random(config.getoption("--slow-until"))  # noqa: S311
    place = {path: drawn.random() for path in sorted(slow)}
    lengths = {path: path.stat().st_size for path in {item.path for item in items}}

    def rank(item: pytest.Item) -> tuple[int, float]:
        if item.name in APART:
            return len(FIRST), 0.0  # others in real time come first, not at the same time
        if item.path.stem in FIRST:
            return FIRST.index(item.path.stem), 0.0
        if item.nodeid.startswith(WAITING):
            return len(FIRST), place.get(item.path, 0.0)
        if item.path in slow:
            return len(FIRST) + 1, place[item.path]
        return len(FIRST) + 2, -lengths[item.path]

    items.sort(key=rank)
