"""Active runs on this machine: a file in the run folder that exists while the run is active, and its processes.

Requests to processes come from the command line or the viewer.
"""

import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import psutil

from model.arrays import Array
from protocol.network.security import Security
from protocol.network.session import BusError, ask
from protocol.scenario.links import PERFECT
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.keys import ROUTER
from protocol.wire.messages import agent_name
from protocol.wire.names import COORDINATOR, PLANT, RECORDER
from transport.flight.fork_server import STOPPED, state_of

_FILE = "live.json"
# Faults of processes that `transport run` causes on request.
FAULTS = ("kill", "stop", "continue", "restart")


@dataclass(frozen=True, slots=True)
class LiveRun:
    """An active run."""

    run: str  # its name
    endpoints: Mapping[str, str]  # endpoints of its processes, by name
    pid: int  # process id of their parent
    keys: str = ""  # folder of their keys; empty without keys
    is_client: bool = False  # whether the endpoints belong to a router


class LiveError(TransportError, ValueError):
    """A file that should describe an active run and does not; one line with file, expected and got."""


def write(folder: Path, run: LiveRun) -> None:
    """Mark a run as active; a folder that cannot be written is left unmarked."""
    new = folder / f".{_FILE}"
    with suppress(OSError):
        new.write_bytes(msgspec.json.encode(run))
        new.replace(folder / _FILE)


def remove(folder: Path) -> None:
    """Mark the run of a folder as ended."""
    with suppress(OSError):
        (folder / _FILE).unlink()


def read(folder: Path) -> LiveRun | None:
    """Return the active run of a folder, or None; the file of a killed run is ignored.

    Raises: LiveError: the file has other content.
    """
    path = folder / _FILE
    try:
        run = msgspec.json.decode(path.read_bytes(), type=LiveRun)
    except OSError:
        return None
    except msgspec.MsgspecError as error:
        raise LiveError(f"{path}: expected the description of an active run ({error})") from None
    return run if psutil.pid_exists(run.pid) else None


def newest_folder(parent: Path) -> Path | None:
    """Return the folder of the most recent active run below a folder.

    Raises: LiveError: the file of a more recent run has other content.
    """
    found = []
    for path in parent.glob(f"*/{_FILE}"):
        if path.parent.is_symlink():
            continue  # `latest` is one of the others
        with suppress(OSError):  # removed since
            found.append((path.stat().st_mtime, path.parent))
    return next((folder for _, folder in sorted(found, reverse=True) if read(folder) is not None), None)


def why_silent(folder: Path, run: LiveRun, name: str) -> str:
    """Return why a process of the active run of a folder cannot answer, and the remedy: it has ended, or is stopped.

    Empty if it runs, was not started by the run, or the system does not tell.
    """
    if not (folder / "logs" / f"{name}.log").exists():
        return ""
    try:
        children = psutil.Process(run.pid).children()
    except psutil.Error:
        return ""
    is_agent = name.startswith("agent")
    words = {("--id", name.removeprefix("agent")) if is_agent else ("transport", name), ("--run", run.run)}
    process = next((child for child in children if words <= _pairs(child) and child.is_running()), None)
    if process is None:
        remedy = f"; transport fault restart {name} starts it again" if is_agent else ", and the run ends"
        return f"{name} of run {run.run} has ended{remedy}"
    if state_of(process) in STOPPED.values():
        remedy = f"; transport fault continue {name} lets it go on" if is_agent else ""
        return f"{name} of run {run.run} is {state_of(process)}{remedy}"
    return ""


def _pairs(process: psutil.Process) -> set[tuple[str, str]]:
    """Return the neighbouring words in the command line of a process; none if it has ended."""
    with suppress(psutil.Error):
        return set(pairwise(" ".join(process.cmdline()).split()))
    return set()


class RefusedError(TransportError, ValueError):
    """The run refuses the request; the text says what was expected."""


class UnansweredError(TransportError, RuntimeError):
    """The process does not exist or does not answer."""

    exit_code = EXIT_UNREACHABLE


def request(
    run: str, endpoints: Sequence[str], name: str, what: str, given: Mapping[str, Any], keys: Path | None = None
) -> dict[str, Any]:
    """Send a request to a process of a run and return the answer.

    Args:
        run: Name of the run.
        endpoints: Endpoints of its processes; that of the receiver is enough.
        name: Receiver: "coordinator" for links and status, "recorder" for faults, any for health.
        what: Request; see docs/protocol.md.
        given: Its arguments.
        keys: Folder of keys, if the run has any.
    Raises: RefusedError, UnansweredError.
    """
    security = None if keys is None else Security(keys.resolve(), (name, ROUTER))
    try:
        answer = dict(ask(run, endpoints, name, what, given, security=security))
    except BusError as error:
        raise UnansweredError(str(error)) from error
    if "error" in answer:
        raise RefusedError(str(answer["error"]))
    return answer


class Commands:
    """Queue of requests to one live run, sent one after the other by a thread.

    It calls `on_result` with a sentence about each result and whether the request was refused.
    """

    def __init__(self, run: LiveRun, on_result: Callable[[str, bool], None]) -> None:
        self._run, self._on_result = run, on_result
        self._requests: queue.SimpleQueue[tuple[str, str, Mapping[str, Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._send_requests, name="commands", daemon=True).start()

    def link(self, ends: tuple[int, int] | None, settings: Mapping[str, Any]) -> None:
        """Change the link from one agent to another, or, for None, all links between agents."""
        source, target = ("", "") if ends is None else (agent_name(ends[0]), agent_name(ends[1]))
        self._requests.put((COORDINATOR, "link", {"from": source, "to": target, "settings": settings}))

    def clear(self) -> None:
        """Make all links perfect, those of the plant included."""
        for ends in ({}, {"from": PLANT}, {"to": PLANT}):
            self._requests.put((COORDINATOR, "link", {**ends, "settings": PERFECT}))

    def target(self, place: Array) -> None:
        """Send the payload to a position, (3,), inertial frame, m."""
        self._requests.put((COORDINATOR, "target", {"points_m": [place.tolist()]}))

    def fault(self, action: str, target: str) -> None:
        """Kill or restart a process."""
        self._requests.put((RECORDER, "fault", {"do": action, "target": target}))

    def _send_requests(self) -> None:
        keys = Path(self._run.keys) if self._run.keys else None
        while True:
            name, kind, content = self._requests.get()
            try:
                answer = request(self._run.run, [self._run.endpoints[name]], name, kind, content, keys)
            except (RefusedError, UnansweredError) as error:
                self._on_result(str(error), True)
                continue
            done = f"{content['do']} {content['target']}" if kind == "fault" else "links change"
            text = f"{done}: at tick {answer['tick']}"
            if kind == "target":
                place, left_s = content["points_m"][-1], answer["ends_s"] - answer["t_s"]
                name = "target ({:g}, {:g}, {:g}) m".format(*place)
                text = f"{name}: arrives at t = {answer['ends_s']:.1f} s, in {left_s:.1f} s"
            self._on_result(text, False)
