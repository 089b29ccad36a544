"""Simulating a run, loading a recorded one, and targets for an active one."""

import sys
import time
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import tomli_w
from rich.console import Console

from transport.flight import active_runs, memory
from transport.flight.progress import RunProgress, compile_models
from transport.flight.run_files import checked, run_header
from transport.interface.recorded_run import Run
from transport.interface.scenario_builder import Scenario, path_phase
from transport.interface.setting_arguments import ArgumentError, Settings, ShortSettings, plain
from transport.log.run_folder import RUNS, new_folder, open_run
from transport.log.run_log import Recorded, RunLog
from transport.protocol.scenario.files.named_files import points_of
from transport.protocol.scenario.scenario_file import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED, TransportError
from transport.protocol.wire.messages import Message, PlantState, Target
from transport.protocol.wire.names import COORDINATOR
from transport.report.report import write_report

_EVERY_S = 0.1  # shortest time between two updates, wall time


def console(*, shown: bool) -> Console:
    """Return the console for progress, on standard error.

    In a notebook it writes lines of text, without widgets; kernels ask for colours (FORCE_COLOR),
    which rich takes for a terminal.
    """
    is_notebook = "ipykernel" in sys.modules
    is_terminal = False if is_notebook else None  # None: rich finds out
    return Console(stderr=True, quiet=not shown, force_jupyter=False, force_terminal=is_terminal)


def fly(
    scenario: "str | PathLike[str] | Scenario" = "paper",
    settings: Settings | None = None,
    *,
    processes: bool = False,
    folder: "str | PathLike[str] | None" = None,
    progress: bool = True,
    path: Sequence[Sequence[float]] | None = None,
    **short: Unpack[ShortSettings],
) -> Run:
    """Simulate a run and return it, also if it diverges.

    In memory by default: the whole team in this process, unpaced, nothing written, with the same
    bits as with processes, which are those of `transport run` and recorded.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}]
    >>> run = transport.fly("resilient", {"links.delay_s": 0.2}, horizon=10, phases=hover)
    >>> run.completed, run.scenario.links.delay_s, run.scenario.controller.horizon
    (True, 0.2, 10)
    >>> transport.fly("resilient", horizn=10)
    Traceback (most recent call last):
        ...
    transport.interface.setting_arguments.ArgumentError: horizn: expected a dotted key such as \
'links.delay_s' or a short name; did you mean 'horizon'?

    Args:
        scenario: Scenario file, name of one that comes with the package, or a `Scenario`.
        settings: Changes by dotted key; list entries count from 1.
        processes: Start a process for each agent, the plant and the coordinator. On Linux, orphaned
            descendants of this process become its children during the run (docs/python.md).
        folder: Run folder to create; by default none in memory, and runs/<time>-<scenario> with
            processes.
        progress: Show the progress on standard error.
        path: Path of the payload in place of the maneuver: rows of time and position,
            (t_s, x_m, y_m, z_m), as an array or a list; both count from the first row. Between rows
            at constant speed; with a flat reference a spline through them, so a few rows are
            enough.
        short: Changes by short name (`transport.interface.setting_arguments.KEY_OF`), such as `horizon=10`.

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is.
        RunError, HarnessError: the processes cannot be started. KeyboardInterrupt: Ctrl-C; no
        process is left.
    """
    flown = Scenario(scenario, settings, **short)
    if path is not None:
        flown.set(phases=[path_phase(path, flat=flown.maneuver.reference == "flat")])
    # A setup of its own: compiled functions must not be used by two threads.
    setup = Setup.of(flown.validated, str(flown.file))

    target = None if folder is None else Path(folder)
    if target is not None and target.exists():  # before the simulation
        raise ArgumentError(f"folder: expected a folder that does not exist yet, got {target}")
    if processes:
        return _with_processes(flown, setup, target, shown=progress)

    if flown.clock.mode != "lockstep":
        reason = "where no time passes (processes=True runs in real time)"
        expected = f"expected lockstep in memory, {reason}"
        raise ScenarioError(str(flown.file), "clock.mode", f"{expected}, got {flown.clock.mode}")

    run = _in_memory(flown, setup, shown=progress)
    if target is not None:
        run.save(target)
    return run


def load(folder: "str | PathLike[str]") -> Run:
    """Return a recorded run from its folder, also one that was cut off.

    `run.summary["log_cut"]` tells whether it was.

    >>> import transport
    >>> transport.load("runs/none")
    Traceback (most recent call last):
        ...
    transport.log.run_log.LogError: runs/none/run.mcap: cannot read the log \
(No such file or directory)

    Raises: LogError: no run folder, or a log that cannot be read. ScenarioError: its scenario
        cannot be read.
    """
    recorded = open_run(Path(folder))
    scenario = Scenario(recorded.scenario_file, allow_large=True)
    return Run(scenario, recorded.setup, recorded.log, Path(folder))


class ActiveRun:
    """A run that is active on this machine, in its run folder `folder`."""

    def __init__(self, folder: Path, there: active_runs.LiveRun) -> None:
        self.folder = folder
        self._live = there

    def __repr__(self) -> str:
        return f"ActiveRun({str(self.folder)!r})"

    def target(
        self,
        x: float,
        y: float,
        z: float,
        *,
        speed: float | None = None,
        to: Sequence[int] = (),
    ) -> dict[str, Any]:
        """Send the payload to a position, inertial frame (z down), m, from the next tick on.

        The largest speed, m/s, is up to 1 m/s, if feasible, by default. The agents in `to`, 1-based,
        are told, and the others learn it from their plans; by default all are told.

        Returns: `tick`, its time `t_s`, and when the reference is there, `reached_s` and `ends_s`.
        Raises: TransportError: it cannot be flown, or the run does not answer.
        """
        return self.path([[x, y, z]], speed=speed, to=to)

    def land(
        self, x: float | None = None, y: float | None = None, *, speed: float | None = None
    ) -> dict[str, Any]:
        """Let the team come down where it is, or at a place to which it goes first, and rest.

        The place is x, y, inertial frame, m. The largest speed, m/s, is 0.5 m/s downwards by default.
        Returns and raises as `target`.
        """
        if (x is None) != (y is None):
            raise ArgumentError(f"x, y: expected both or none, got {x}, {y}")
        given: dict[str, Any] = {"land": True}
        if x is not None:
            given["land_at_m"] = [plain(x), plain(y)]
        if speed is not None:
            given["speed_mps"] = plain(speed)
        return self._ask(given)

    def path(
        self,
        points: "Sequence[Sequence[float]] | str | PathLike[str]",
        *,
        times: Sequence[float] | None = None,
        speed: float | None = None,
        to: Sequence[int] = (),
    ) -> dict[str, Any]:
        """Send the payload through way points on a smooth curve.

        The curve begins once it has reached the first of them. Points are positions, (k, 3),
        inertial frame, m, or a CSV file with columns x,y,z or t,x,y,z; times, s, count from that of
        the first one and replace a largest speed, m/s.
        `to`, returned and raised: as `target`.
        """
        if isinstance(points, str | PathLike):
            points, times = points_of(Path(points))

        every = {"points_m": plain(points), "times_s": plain(times), "speed_mps": plain(speed)}
        given = {key: value for key, value in every.items() if value is not None}
        if to:
            given["to"] = [int(agent) for agent in to]
        return self._ask(given)

    def _ask(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the coordinator's answer to a target.

        Raises: TransportError: the folder has another active run by now, or none.
        """
        if active_runs.read(self.folder) != self._live:
            raise TransportError(f"the run in {self.folder} has ended")
        return self._live.ask(COORDINATOR, "target", given)


def active(folder: "str | PathLike[str] | None" = None) -> ActiveRun:
    """Return the active run of a folder, by default the most recent one in `runs`.

    Raises: ArgumentError: there is none.
    """
    run_folder = active_runs.newest_folder(RUNS) if folder is None else Path(folder)
    running = None if run_folder is None else active_runs.read(run_folder)
    if run_folder is None or running is None:
        raise ArgumentError(f"no active run in {RUNS if folder is None else folder}")
    return ActiveRun(run_folder, running)


def _in_memory(scenario: Scenario, setup: Setup, *, shown: bool) -> Run:
    """Simulate a run in this process."""
    began_ns = time.time_ns()
    began_s = time.monotonic()
    compile_models([setup.scenario], console(shown=shown))
    text = tomli_w.dumps(setup.scenario.tree())
    header = run_header(setup, setup.scenario.name, 1, text, checked(setup))
    header = {**header, "command_started_ns": str(began_ns)}

    messages: list[Recorded] = []
    next_s = began_s
    with RunProgress(setup, console(shown=shown), waiting="in memory") as progress:

        def record(message: Message) -> None:
            nonlocal next_s
            messages.append(Recorded(message=message, received_ns=time.time_ns()))
            if isinstance(message, Target):
                progress.setup = progress.setup.after([message])
            elif isinstance(message, PlantState) and time.monotonic() >= next_s:
                next_s = time.monotonic() + _EVERY_S
                progress.show(message, began_s)

        memory.simulate(setup, record)

    log = RunLog(header=header, messages=tuple(messages), cut="")
    return Run(scenario, setup, log)


def _with_processes(scenario: Scenario, setup: Setup, folder: Path | None, *, shown: bool) -> Run:
    """Simulate a run with a process for each part, and write its report."""
    # Imported when needed: a run in memory starts no process.
    from transport.flight import run_execution as processes_run
    from transport.flight.fork_server import close_fork_server

    target = new_folder(RUNS, setup.scenario.name) if folder is None else folder
    try:
        finished = processes_run.simulate(setup, target, console(shown=shown))
    finally:
        close_fork_server()

    write_report(finished.folder, setup=setup)
    if finished.exit_code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt(f"interrupted; recorded in {finished.folder}")
    return Run(scenario, setup, open_run(finished.folder, setup=setup).log, finished.folder)
