"""One run on this machine, from scenario to run folder."""

import os
import platform
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import tomli_w
from rich.console import Console

from model import native
from model.compiled import compile_functions
from protocol.network.endpoints import Endpoints, endpoints_of_all, process_names
from protocol.network.process import Place
from protocol.network.security import Security, SecurityError, new_secret
from protocol.network.session import BusError
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.names import COORDINATOR
from transport.flight import live
from transport.flight.fault_script import FaultScript
from transport.flight.harness import ORDERLY_ENDS, Child, Harness, check_ports, free_ports
from transport.flight.progress import RunProgress
from transport.flight.recorder import Recorder
from transport.flight.signals import collected_signals
from transport.log.latest import forget_latest, point_latest
from transport.log.run_log import LogError, LogWriter

# Time for the processes to end after the run before they are killed.
_LEAVE_S = 3.0
_POLL_S = 0.05
# Time for the recorder to receive the messages of a run whose processes have ended.
_CATCH_UP_S = 2.0


class RunError(RuntimeError):
    """A run that could not be started: one line for the user, and the exit code of the command."""

    def __init__(self, text: str, exit_code: int) -> None:
        super().__init__(text)
        self.exit_code = exit_code


@dataclass(frozen=True, slots=True)
class Finished:
    """End of a run: its folder, complete except for the report, exit code, and reason in a line, empty if completed."""

    folder: Path
    exit_code: int
    reason: str


def new_folder(parent: Path, name: str) -> Path:
    """Return the path of a new run folder, named by time and scenario."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    folder, count = parent / f"{stamp}-{name}", 1
    while folder.exists():
        count += 1
        folder = parent / f"{stamp}-{name}-{count}"
    return folder


def simulate(
    setup: Setup,
    folder: Path,
    console: Console,
    started: Callable[[], None] = lambda: None,
    ready: Callable[[], None] = lambda: None,
) -> Finished:
    """Start the processes of a run, record it in a new folder, and wait for its end.

    `started` is called once the processes are started; before the first tick they wait for `ready` to return.

    Returns: The end of the run; every process has ended and the log is complete.
    Raises: RunError: the folder exists, or a process ended before the run began. HarnessError: no free port.
    """
    _refuse_existing(folder)
    scenario = setup.scenario
    with console.status("compiling the model for this processor, once"):
        compile_functions(setup.system.N)
    names = process_names(scenario)
    host, base_port = scenario.network.host, scenario.network.base_port
    # The recorder has a port for requests to the parent of the processes.
    with free_ports(host, 1 if base_port is not None else 1 + len(names)) as (own, *ports):
        if base_port is not None:
            ports = list(range(base_port, base_port + len(names)))
            check_ports(host, ports)
        try:
            found = endpoints_of_all([*names, RECORDER], scenario, [*ports, own])
        except SecurityError as error:
            raise RunError(str(error), EXIT_SCENARIO) from error
        recording = found.pop(RECORDER)
        try:
            return _simulate(setup, folder, console, found, recording, started, ready)
        except BusError as error:
            raise RunError(str(error), EXIT_UNREACHABLE) from error


def _simulate(
    setup: Setup,
    folder: Path,
    console: Console,
    places: Mapping[str, Endpoints],
    recording: Endpoints,
    started: Callable[[], None],
    ready: Callable[[], None],
) -> Finished:
    """Simulate a run with given endpoints of its processes and of its recorder."""
    scenario, names = setup.scenario, list(places)
    run = folder.name if Keys.allows(folder.name) else scenario.name
    text = _create(folder, setup)
    header = run_header(setup, run, len(names), text)
    called = {name: [*place.listen, *place.connect][0] for name, place in [*places.items(), (RECORDER, recording)]}
    with (
        _own_keys(scenario, folder) as own,
        Harness(run, folder / "scenario.toml", places, folder / "logs", own) as harness,
        RunProgress(setup, console) as progress,
    ):
        if own is not None:
            recording = replace(recording, security=Security(own, ()))
        keys = "" if recording.security is None else str(recording.security.folder)
        harness.start(observers=[RECORDER])
        writer = _open_log(folder, header, setup.period_ns)
        recorder = Recorder(
            setup,
            run,
            writer,
            recording,
            scenario.clock.join_timeout_s,
            has_ended=lambda: harness.has_ended(COORDINATOR),
        )
        try:
            live.write(folder, live.LiveRun(run, called, os.getpid(), keys, is_client=recording.mode == "client"))
            ready()  # the coordinator waits for the recorder
            recorder.start(names)
            started()
            _watch(harness, recorder, progress, FaultScript(setup, harness, recorder))
            if recorder.control is not None:
                harness.wait(_LEAVE_S)
        finally:
            recorder.close()
            live.remove(folder)
            if recorder.error is None and not harness.ended():
                _discard_if_empty(folder, recorder)
    return _finished(folder, recorder)


@contextmanager
def _own_keys(scenario: Scenario, folder: Path) -> Iterator[Path | None]:
    """Make the secret of a run in its folder; None where other keys protect the run, or it is to be open."""
    network = scenario.network
    if network.keys is not None or network.router is not None or not network.secret:
        yield None
        return
    with new_secret(folder.resolve() / "keys") as keys:
        yield keys


def observe(setup: Setup, place: Place, folder: Path, console: Console) -> Finished:
    """Record a run whose processes are started elsewhere, in a new folder.

    Raises: RunError: the folder exists, or the processes did not join.
    """
    names = process_names(setup.scenario)
    text = _create(folder, setup)
    with RunProgress(setup, console) as progress:
        header = run_header(setup, place.run, len(names), text)
        writer = _open_log(folder, header, setup.period_ns)
        try:
            recorder = Recorder(setup, place.run, writer, place.endpoints, place.join_timeout_s, place.incarnation)
        except BusError as error:
            writer.close()
            shutil.rmtree(folder, ignore_errors=True)
            raise RunError(str(error), EXIT_UNREACHABLE) from error
        try:
            recorder.start(names)
            _watch(None, recorder, progress, None)
        finally:
            recorder.close()
            _discard_if_empty(folder, recorder)
    return _finished(folder, recorder)


def run_header(setup: Setup, run: str, processes: int, scenario_toml: str) -> Mapping[str, str]:
    """Return the metadata of a run's log."""
    return {
        "run_id": run,
        "scenario": scenario_toml,
        "seed": str(setup.scenario.seed),
        "processes": str(processes),
        "versions": versions(),
        "machine": machine(),
        "command_started_ns": str(_command_started_ns()),
    }


def versions() -> str:
    """Return the versions of Python, packages and kernels that results depend on, in one line."""
    packages = ("payload-transport", "numpy", "casadi", "daqp", "clarabel", "eclipse-zenoh")
    found = [f"python {platform.python_version()}", *(f"{package} {version(package)}" for package in packages)]
    return ", ".join([*found, f"kernels {'compiled' if native.AVAILABLE else 'plain'}"])


def machine() -> str:
    """Return the machine in one line: processor, cores this process may use, system."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{processor}, {cores} cores, {platform.system()} {platform.release()}"


def _command_started_ns() -> int:
    """Return the wall-clock time at which this process was started, ns since 1970; now where /proc is missing."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
        up_s = float(Path("/proc/uptime").read_text().split()[0])
        return time.time_ns() - round((up_s - ticks / os.sysconf("SC_CLK_TCK")) * 1e9)
    except (OSError, ValueError, IndexError):
        return time.time_ns()


def _refuse_existing(folder: Path) -> None:
    if folder.exists():
        raise RunError(f"--out: expected a folder that does not exist yet, got {folder}", EXIT_USAGE)


def _create(folder: Path, setup: Setup) -> str:
    """Create the run folder with the resolved scenario; return its text."""
    _refuse_existing(folder)
    text = tomli_w.dumps(setup.scenario.tree())
    try:
        folder.mkdir(parents=True)
        (folder / "scenario.toml").write_text(text, encoding="utf-8")
        for name, delays_s in setup.samples_s.items():
            if not Path(name).is_absolute():  # the run folder is self-contained
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_text("\n".join(map(repr, delays_s)) + "\n", encoding="utf-8")
    except OSError as error:
        raise RunError(f"--out: cannot create {folder} ({error.strerror})", EXIT_USAGE) from error
    point_latest(folder)
    return text


def _discard_if_empty(folder: Path, recorder: Recorder) -> None:
    """Remove the folder of a run without any message, so that the same command can be repeated."""
    if recorder.received == 0:
        forget_latest(folder)
        shutil.rmtree(folder, ignore_errors=True)


def _open_log(folder: Path, header: Mapping[str, str], period_ns: int) -> LogWriter:
    try:
        return LogWriter(folder / "run.mcap", header, period_ns=period_ns)
    except LogError as error:
        raise RunError(str(error), EXIT_USAGE) from error


def _finished(folder: Path, recorder: Recorder) -> Finished:
    if recorder.error is not None:
        raise RunError(recorder.error, EXIT_UNREACHABLE)
    if recorder.control is None and recorder.started_s is not None:
        return Finished(folder, EXIT_INTERRUPTED, "recording interrupted; the run may continue without it")
    if recorder.control is None:
        raise RunError("the run ended before its first tick", EXIT_UNREACHABLE)
    return Finished(folder, recorder.control.exit_code, recorder.control.reason)


def _watch(harness: Harness | None, recorder: Recorder, progress: RunProgress, faults: FaultScript | None) -> None:
    """Show progress until the run has ended; forward Ctrl-C; refuse processes that end too early."""
    shown = 0
    with collected_signals() as signals:
        interrupted = 0
        ended_s: float | None = None
        while recorder.running:
            recorder.join(_POLL_S)
            progress.show(recorder.plant_state, recorder.started_s)
            if faults is not None:
                faults.work()
            for notice in recorder.notices[shown:]:
                progress.say(notice)
            shown = len(recorder.notices)
            if len(signals) > interrupted:
                interrupted = len(signals)
                if interrupted > 1 or recorder.started_s is None:
                    raise RunError(f"interrupted ({signals[-1]})", EXIT_INTERRUPTED)
                if harness is None:
                    recorder.stop(signals[-1])
                    continue
                progress.say(f"{signals[-1]}: ending the run; once more to end it at once")
                harness.signal(COORDINATOR, signal.Signals[signals[-1]])
            ended = [] if harness is None else harness.ended()
            if ended and recorder.started_s is None and recorder.control is None:
                # A run may end within its first ticks: its messages can reach the recorder after a process has ended.
                ended_s = time.monotonic() if ended_s is None else ended_s
                orderly = all(child.process.returncode in ORDERLY_ENDS for child in ended)
                if not orderly or time.monotonic() - ended_s > _CATCH_UP_S:
                    raise _ended_early(ended)


def _ended_early(ended: list[Child]) -> RunError:
    child = ended[0]
    code = child.process.returncode
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    # A child refuses the same options and scenario as this command would; any other end is that of a peer.
    passed_on = code in (EXIT_USAGE, EXIT_SCENARIO)
    return RunError(
        f"{child.name} {how} before the run began: {child.last_line()}", code if passed_on else EXIT_UNREACHABLE
    )
