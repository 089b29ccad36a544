"""Early signals campaign: interrupts commands within their first second.

The command must end with the exit code of an interrupt, without a traceback, a process, or a folder
of a run that has not begun.
"""

import os
import random
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from tests.campaigns.harness import Result
from tests.campaigns.signals import end_orphans
from tests.support.commands import wait_for
from transport.interface.fly import fly
from transport.log.run_log import read_log
from transport.protocol.network.parent_and_environment import python
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED
from transport.protocol.wire.messages import Tick

# Commands that last until they are interrupted, with their arguments, and their share of the draws.
_HOVER = "maneuver.phase=[{name='hover',duration_s=60.0,displacement_m=[0,0,0]}]"
_RUN = ("run", "paper", "--set", _HOVER, "--set", "clock.speed=1.0", "--no-figures")
_COMMANDS = {
    "run": (*_RUN, "--out", "run"),
    "run, one agent for all": (*_RUN, "--set", "agents.owned=[[1,2,3,4]]", "--out", "run"),
    "view": ("view", "recorded", "--port", "0"),
    "experiment": ("experiment", "latency", "--jobs", "1", "--out", "experiment"),
    "router": ("router", "--listen", "tcp/127.0.0.1:0"),
    "coordinator": (
        *("coordinator", "--scenario", "paper", "--set", "clock.join_timeout_s=600"),
        *("--listen", "tcp/127.0.0.1:{port}"),
    ),
    "metrics": ("metrics", "--port", "{port}"),
}
_WEIGHTS = (8, 2, 4, 2, 1, 1, 1)
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# Latest time of the signal after the start of the command, and time for the command to end, s.
_LATEST_S, _END_S = 1.0, 40.0
_FIRST_PORT = 21_000  # below the system's free ports


@cache
def _recorded_folder() -> Path:
    """Record a short run to be shown, once."""
    folder = Path(mkdtemp(prefix="early-signals-")) / "recorded"
    phase = {"name": "hover", "duration_s": 0.2, "displacement_m": [0.0, 0.0, 0.0]}
    fly("paper", settings={"maneuver.phase": [phase]}).save(folder)
    return folder


_turn = threading.Lock()  # `cache` alone would record twice


def execute(seed: int, number: int, folder: Path, stop: threading.Event) -> Result:
    """Start the command of a number, interrupt it and check what is left."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    (name,) = rng.choices(list(_COMMANDS), _WEIGHTS)
    sent = rng.choice(_SIGNALS)
    after_s = rng.uniform(0.0, _LATEST_S)

    with _turn:
        (folder / "recorded").symlink_to(_recorded_folder())
    port = str(_FIRST_PORT + number % 5000)
    arguments = [argument.replace("{port}", port) for argument in _COMMANDS[name]]
    with (folder / "output.txt").open("wb") as output:
        command = subprocess.Popen(
            [*python("transport"), *arguments],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )

    def is_over() -> bool:
        return command.poll() is not None or stop.is_set()

    ended_alone = wait_for(is_over, after_s)
    with suppress(ProcessLookupError):
        os.kill(command.pid, sent)
    is_lost = not wait_for(is_over, _END_S)
    if is_lost:
        command.kill()
    code = command.wait()

    problems = dict(_problems(folder, code))
    if ended_alone:
        problems["ended alone"] = f"exit code {code} before the signal"
    if is_lost:
        problems["signal lost"] = f"the command has not ended within {_END_S:g} s"
    details = (f"{sent.name} to transport {name} after {after_s:.3f} s",)
    outcome = f"exit {code}"
    return Result(number=number, label=name, outcome=outcome, problems=problems, details=details)


def _problems(folder: Path, code: int) -> Iterator[tuple[str, str]]:
    """Yield what is wrong after a command has ended, by kind."""
    text = (folder / "output.txt").read_text(errors="replace")
    is_traceback = "Traceback (most recent call last)" in text
    is_ours = f"{os.sep}transport{os.sep}" in text
    # Before the first line of the command the system ends it, or the interpreter in its own start.
    # The viewer and the exporter end in order: code 0.
    expected = {EXIT_INTERRUPTED, 0, *(-number for number in _SIGNALS)}
    if is_traceback and not is_ours:
        expected.add(1)
    if code not in expected:
        yield "wrong exit code", f"{code}, expected one of {sorted(expected)}"
    left = end_orphans(folder)
    if left:
        yield "orphan", left
    if is_traceback and is_ours:
        yield "traceback", text.strip().splitlines()[-1]
    run = folder / "run"
    if run.exists() and not _has_begun(run):
        yield "folder", ", ".join(path.name for path in run.iterdir())


def _has_begun(run: Path) -> bool:
    """Return whether the log of a run has a tick."""
    log = run / "run.mcap"
    return log.exists() and bool(read_log(log).of(Tick))
