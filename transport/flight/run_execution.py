"""One run on this machine, from scenario to run folder."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from transport.flight import active_runs
from transport.flight.fault_script import FaultScript
from transport.flight.local_processes import (
    Harness,
    free_udp_ports,
    keys_setting,
    reserved_ports,
)
from transport.flight.observer_priority import below_the_team
from transport.flight.progress import RunProgress, compile_models
from transport.flight.recorder import Recorder
from transport.flight.run_files import (
    NewFolder,
    RunError,
    checked,
    existing,
    new_run_folder,
    own_keys,
    run_header,
)
from transport.flight.run_watch import RunWatch
from transport.log.writer import LogWriter
from transport.protocol.network.bus_events_and_clock import Place
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import mesh, process_names
from transport.protocol.network.security import Security
from transport.protocol.network.session import check_usable
from transport.protocol.scenario.sections.vehicles_section import DEFAULT_VEHICLE_PORT
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.key_expressions import RECORDER, Keys

# Time for the processes to end after the run, s.
_LEAVE_S = 3.0


@dataclass(frozen=True, slots=True)
class Finished:
    """End of a run.

    Attributes:
        folder: Run folder, complete except for the report.
        exit_code: Exit code of the command.
        reason: One line, empty if the run completed.
    """

    folder: Path
    exit_code: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Addresses:
    """Name of a run on the network, and the addresses of its processes.

    Attributes:
        run: Name of the run.
        processes: Endpoints of agents, plant and coordinator by name.
        recorder: Endpoints of the recorder, which also listens for requests to this process.
    """

    run: str
    processes: Mapping[str, Endpoints]
    recorder: Endpoints

    @property
    def keys(self) -> str:
        """Absolute path of the folder of keys; empty without keys."""
        security = self.recorder.security
        return "" if security is None else str(security.folder.absolute())

    def asked_at(self) -> dict[str, str]:
        """Return the endpoint at which each process answers requests, by name."""
        everyone = {**self.processes, RECORDER: self.recorder}
        return {name: [*place.listen, *place.connect][0] for name, place in everyone.items()}


def simulate(
    setup: Setup,
    folder: Path,
    console: Console,
    started: Callable[[], None] = lambda: None,
    ready: Callable[[], object] = lambda: None,
    external: Collection[str] = (),
) -> Finished:
    """Start the processes of a run, record it in a new folder, and wait for its end and theirs.

    Args:
        setup: The run.
        folder: Run folder to create.
        console: Console for the progress.
        started: Called once the processes are started.
        ready: The processes wait for its return before the first tick.
        external: Names of processes that join from elsewhere.

    Raises: TransportError. KeyboardInterrupt.
    """
    if folder.exists():  # told before a first compilation
        raise existing(folder)

    with ExitStack() as stack:
        check_usable()
        classes = checked(setup, external)
        compile_models([setup.scenario], console)

        addresses = stack.enter_context(_reserved(setup, folder))
        made = stack.enter_context(new_run_folder(folder, setup))
        names = list(addresses.processes)
        header = run_header(setup, addresses.run, len(names), made.scenario_toml, classes)
        progress = stack.enter_context(RunProgress(setup, console))

        own = stack.enter_context(own_keys(setup.scenario, folder))
        if own is not None:
            secured = replace(addresses.recorder, security=Security(own, ()))
            addresses = replace(addresses, recorder=secured)

        harness = stack.enter_context(_harness(addresses, folder, own, external, progress))
        place = Place(
            run=addresses.run,
            endpoints=addresses.recorder,
            join_timeout_s=setup.scenario.clock.join_timeout_s,
        )
        # The recorder opens its session while the fork server prepares the other processes.
        recorder = stack.enter_context(_recorded(place, made, header, progress, harness))
        harness.start(harness.mesh)

        with _marked_active(folder, addresses):
            ready()  # no tick passes meanwhile: the coordinator waits for the recorder, which joins now
            recorder.start(names)
            for name in external:
                progress.say(_invitation(name, addresses, setup.scenario.digest()))
            started()

            with below_the_team():
                faults = FaultScript(setup, harness, recorder)
                RunWatch(recorder, progress, harness, faults).until_end()
            if recorder.control is not None:
                harness.wait(_LEAVE_S)
    return _finished(folder, recorder, harness)


@contextmanager
def _reserved(setup: Setup, folder: Path) -> Iterator[_Addresses]:
    """Reserve the ports of a run while the context is open, and yield its addresses.

    Raises: HarnessError: a port is taken. ScenarioError, SecurityError: an address or a key cannot
        be used.
    """
    scenario = setup.scenario
    names = process_names(scenario)
    base_port = scenario.network.base_port
    any_port = 0
    wanted = [any_port] * len(names)
    if base_port is not None:
        wanted = list(range(base_port, base_port + len(names)))

    # The port of the recorder comes first, so that it is taken even if a wanted one is not free.
    with reserved_ports(scenario.network.host, [any_port, *wanted]) as (own_port, *ports):
        places = mesh(scenario, [*names, RECORDER], [*ports, own_port])
        insecure = scenario.network.insecure
        checked_places = {
            name: place.checked(name, insecure=insecure) for name, place in places.items()
        }
        recorder = checked_places.pop(RECORDER)
        run = folder.name if Keys.allows(folder.name) else scenario.name
        yield _Addresses(run=run, processes=checked_places, recorder=recorder)


@contextmanager
def _harness(
    addresses: _Addresses,
    folder: Path,
    own_keys_folder: Path | None,
    external: Collection[str],
    progress: RunProgress,
) -> Iterator[Harness]:
    """Yield the harness of the processes that are not external, and end them with the context."""
    own = {name: place for name, place in addresses.processes.items() if name not in external}
    scenario_file = folder / "scenario.toml"
    harness = Harness(addresses.run, scenario_file, own, folder / "logs", own_keys_folder)
    scenario = progress.setup.scenario
    if scenario.plant.autopilot is not None:
        given = scenario.network.vehicle_port
        harness.vehicle_port = given or free_udp_ports(progress.setup.system.N)
        harness.stands = True
        harness.autopilot = scenario.plant.autopilot
    elif scenario.has_vehicles:
        harness.vehicle_port = scenario.network.vehicle_port or DEFAULT_VEHICLE_PORT
        harness.autopilot = scenario.vehicles.autopilot
    try:
        yield harness
    finally:
        harness.end(progress.say)


@contextmanager
def _marked_active(folder: Path, addresses: _Addresses) -> Iterator[None]:
    """Mark a run as active while the context is open, so that viewers and requests find it."""
    try:
        endpoints = addresses.asked_at()
        active_runs.write(
            folder, active_runs.LiveRun(addresses.run, endpoints, os.getpid(), addresses.keys)
        )
        yield
    finally:
        active_runs.remove(folder)


def _invitation(name: str, addresses: _Addresses, digest: str) -> str:
    """Return a line with all that an external process needs to join."""
    place = addresses.processes[name]
    needs = f"; it needs --set '{keys_setting(addresses.keys)}'" if addresses.keys else ""
    return (
        f"waiting for {name} of run {addresses.run}, digest {digest}; it {place.in_words()}{needs}"
    )


def observe(setup: Setup, place: Place, folder: Path, console: Console) -> Finished:
    """Record a run whose processes are started elsewhere, in a new folder.

    Raises: TransportError.
    """
    names = process_names(setup.scenario)
    classes = {
        "engine": setup.scenario.plant.engine,
        "controller": ", ".join(dict.fromkeys(setup.scenario.controllers)),
    }
    with new_run_folder(folder, setup) as made:
        header = run_header(setup, place.run, len(names), made.scenario_toml, classes)
        with (
            RunProgress(setup, console) as progress,
            _recorded(place, made, header, progress) as recorder,
        ):
            recorder.start(names)
            RunWatch(recorder, progress).until_end()
    return _finished(folder, recorder)


@contextmanager
def _recorded(
    place: Place,
    made: NewFolder,
    header: Mapping[str, str],
    progress: RunProgress,
    harness: Harness | None = None,
) -> Iterator[Recorder]:
    """Open log and recorder of a run; decide in the end whether its folder is kept.

    Kept is one with a message; or without, if a process or the recorder has failed: the logs tell why.
    Not kept is that of a run interrupted before its first tick.
    """

    def is_starting(name: str) -> bool:
        return harness is not None and harness.is_starting(name, place.join_timeout_s)

    recorder = None
    is_interrupted = False
    try:
        log = made.path / "run.mcap"
        writer = LogWriter(log, header, period_ns=progress.setup.period_ns, say=progress.say)
        with closing(writer):
            recorder = Recorder(progress.setup, place, writer, progress.say, is_starting)
            with closing(recorder):
                yield recorder
    except KeyboardInterrupt:
        is_interrupted = True
        raise
    finally:
        if recorder is not None:
            is_told = harness is not None and bool(recorder.error or harness.ended())
            is_early = is_interrupted and recorder.started_s is None
            made.is_kept = not is_early and (recorder.received > 0 or is_told)


def _finished(folder: Path, recorder: Recorder, harness: Harness | None = None) -> Finished:
    """Return how a run ended; raise RunError if it did not begin or was not recorded."""
    control = recorder.control
    logs = "" if harness is None else f"; logs in {harness.logs}"
    if recorder.error is not None:
        raise RunError(f"{recorder.error}{logs}", codes.EXIT_UNREACHABLE)
    if control is None and recorder.started_s is None:
        raise RunError(f"the run ended before its first tick{logs}", codes.EXIT_UNREACHABLE)
    if control is None:
        reason = "recording interrupted; the run may continue without it"
        return Finished(folder, codes.EXIT_INTERRUPTED, reason)

    if recorder.writer.lost:
        text = f"{recorder.writer.lost}; the run {control.outcome} {control.reason}".rstrip()
        raise RunError(text, control.exit_code or codes.EXIT_UNRECORDED)

    reason = control.reason
    is_unreachable = control.exit_code == codes.EXIT_UNREACHABLE
    if is_unreachable:
        reason = f"{_cause(reason, harness)}{logs}"
    if is_unreachable and recorder.started_s is None:  # there is nothing to report
        raise RunError(f"{reason}; the run ended before its first tick", control.exit_code)
    return Finished(folder, control.exit_code, reason)


def _cause(reason: str, harness: Harness | None) -> str:
    """Return why a run was aborted: the error of the process that is gone comes first."""
    for child in [] if harness is None else harness.ended():
        if child.code != 0 and f"{child.name} is gone" in reason:
            error = child.last_words or f"{child.name} {child.how_it_ended}"
            return f"{error}; so {reason}"
    return reason
