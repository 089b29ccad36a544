"""Scenarios campaign: mutates scenarios, validates and simulates them.

Each mutated scenario goes through `transport validate` in a process of its own with limits on
memory and processor time; a scenario that is accepted is simulated in memory for a few ticks.
Neither may end with a traceback, use more than 1 GB, or compute for 10 s without a sign. Where the
simulation has a large team in one process, it may use as much as its share of the limits on size,
while each process of `transport run` is within 1 GB. The limits are of processor time, so the
result does not depend on the load of the host.
"""

import contextlib
import io
import json
import os
import random
import resource
import signal
import threading
import tomllib
import traceback
from functools import cache
from pathlib import Path
from typing import Any

import psutil

from tests.campaigns.harness import Result
from tests.support.mutations import mutated
from transport.cli.commands.scenario import validate
from transport.flight.memory import simulate
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.sections.limits_on_size import (
    MOST_AGENT_STEPS,
    MOST_ENTRIES,
    size_of,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, PlantState

READY = ("paper", "centralized", "resilient", "precise", "windy", "collision")
TICKS = 5

LARGEST_BYTES = 1024**3
SILENCE_S = 10.0  # of processor time
_ADDRESS_BYTES = 6 * 1024**3  # stops a scenario before it stops the host
_ASLEEP_S = 120.0  # of wall-clock time: waits for something that does not come, also on a busy host

REFUSED, ENDED, FLOWN = "refused", "ended early", "simulated"
PROBLEMS = ("traceback", "no clear line", "over 1 GB", "silent")


class _Enough(Exception):  # noqa: N818  # no error
    """Enough ticks were simulated."""


def attempt(content: bytes, folder: Path, ticks: int = TICKS) -> tuple[str, str, int, float]:
    """Validate and simulate a scenario in a forked process.

    Return outcome, text, peak of the memory that it does not share, and processor time.
    """
    path = folder / "scenario.toml"
    path.write_bytes(content)
    reads, writes = os.pipe()
    shared = psutil.Process().memory_info().rss  # with this process, where many tests may have run
    child = os.fork()
    if child == 0:
        os.close(reads)
        with contextlib.suppress(BaseException):
            _limit()
            outcome, text, most_bytes = _outcome(path, ticks)
            os.write(writes, json.dumps([outcome, text[:2000], most_bytes]).encode())
        os._exit(0)
    os.close(writes)
    with os.fdopen(reads, "rb") as told:
        line = told.read()
    _, status, used = os.wait4(child, 0)
    outcome, text, most_bytes = json.loads(line or b'["traceback", "no result", 0]')
    if os.WIFSIGNALED(status):
        number = signal.Signals(os.WTERMSIG(status))
        outcome, text = (
            "silent" if number in (signal.SIGPROF, signal.SIGALRM) else "traceback",
            number.name,
        )
    peak = used.ru_maxrss * 1024 - shared
    if outcome not in ("silent", "traceback") and peak > most_bytes:
        outcome, text = (
            "over 1 GB",
            f"{peak / 1e6:,.0f} MB, expected at most {most_bytes / 1e6:,.0f} MB",
        )
    return outcome, text, peak, used.ru_utime + used.ru_stime


def _limit() -> None:
    """Limit memory and time of this process; the latter ends it with SIGPROF or SIGALRM."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_BYTES, _ADDRESS_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    null = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):
        os.dup2(null, standard)
    _sign()


def _sign() -> None:
    """Start the time of silence anew."""
    signal.setitimer(signal.ITIMER_PROF, SILENCE_S)
    signal.setitimer(signal.ITIMER_REAL, _ASLEEP_S)


def _outcome(path: Path, ticks: int) -> tuple[str, str, float]:
    """Return outcome, text, and the most memory that it may take, bytes."""
    try:
        refusal = _refusal(path)
        if refusal is not None:
            clear = (
                refusal.startswith("transport: ")
                and refusal.count("\n") == 1
                and "Error(" not in refusal
            )
            return (REFUSED if clear else "no clear line"), refusal, LARGEST_BYTES
        _sign()
        scenario = read_scenario(path)
        size = size_of(scenario)
        share = size.agent_steps / MOST_AGENT_STEPS + size.entries / MOST_ENTRIES
        most_bytes = LARGEST_BYTES * (1.0 + 4.0 * share)
        return *_simulated(Setup.of(scenario, str(path)), ticks), most_bytes
    except BaseException:  # noqa: BLE001  # any error here is a result
        return "traceback", traceback.format_exc(), LARGEST_BYTES


def _refusal(path: Path) -> str | None:
    """Return what `transport validate` says of a scenario it refuses, None of one it accepts."""
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            validate(str(path))
    except ScenarioError as error:
        return f"transport: {error}\n"
    return None


def _simulated(setup: Setup, ticks: int) -> tuple[str, str]:
    seen = 0

    def record(message: Message) -> None:
        nonlocal seen
        _sign()  # each agent's step is one: they have a process each in `transport run`
        if isinstance(message, PlantState):
            seen += 1
            if seen >= ticks:
                raise _Enough

    try:
        end = simulate(setup, record)
    except _Enough:
        return FLOWN, ""
    return (FLOWN if end.outcome == "completed" else ENDED), end.reason


def scenario(seed: int, number: int) -> tuple[bytes, str]:
    """Return a mutated scenario and the kind of its mutation."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    tree: dict[str, Any] = tomllib.loads(
        find_scenario(rng.choice(READY)).read_text(encoding="utf-8")
    )
    return mutated(tree, rng)


@cache
def _prepare() -> None:
    """Compile functions and fill caches, which the forked processes share."""
    for name in READY:
        path = find_scenario(name)
        Setup.of(read_scenario(path), str(path)).model  # noqa: B018


def execute(
    seed: int, number: int, folder: Path, _stop: threading.Event | None = None, ticks: int = TICKS
) -> Result:
    """Validate and simulate the mutated scenario of a number."""
    _prepare()
    (folder / "delays.csv").write_text("0.01 0.02 0.05", encoding="utf-8")
    (folder / "path.csv").write_text(
        "t_s,x_m,y_m,z_m\n0,0,0,0\n2,0,0,-1\n4,1,0,-1\n", encoding="utf-8"
    )
    content, kind = scenario(seed, number)
    outcome, text, peak, cpu_s = attempt(content, folder, ticks)
    used = f"{peak / 1024**2:.0f} MiB of memory, {cpu_s:.1f} s of processor time"
    problems = {outcome: text} if outcome in PROBLEMS else {}
    return Result(number=number, label=kind, outcome=outcome, problems=problems, details=(used,))
