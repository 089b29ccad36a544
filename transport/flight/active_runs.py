"""Active runs on this machine, and requests to them.

A file in the run folder exists while the run is active.
"""

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import psutil

from transport.flight import register_of_active_runs
from transport.model.arrays import Array
from transport.protocol.network.requests_and_answers import Reach, ask
from transport.protocol.network.security import Security
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.links.link_changes import PERFECT
from transport.protocol.wire.errors_and_exit_codes import TransportError
from transport.protocol.wire.key_expressions import ROUTER
from transport.protocol.wire.names import COORDINATOR, RECORDER, agent_name

_FILE = "live.json"
# Process ids have 31 bits in POSIX; an id of 0 or below would mean a group.
Pid = Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)]


@dataclass(frozen=True, slots=True)
class LiveRun:
    """An active run."""

    run: str  # its name
    endpoints: Mapping[str, str]  # endpoints of its processes, by name
    pid: Pid  # process id of their parent
    keys: str = ""  # absolute path of the folder of their keys; empty without keys

    def ask(
        self, name: str, what: str, given: Mapping[str, Any], keys: Path | None = None
    ) -> dict[str, Any]:
        """Return the answer of one of its processes to a request, as `request`."""
        if not _is_running(self.pid):
            raise TransportError(f"run {self.run} has ended")
        own_keys = Path(self.keys) if self.keys else None
        # Connect only to the process that is asked: a stopped one delays the connection.
        return request(self.run, [self.endpoints[name]], name, what, given, keys or own_keys)


def write(folder: Path, run: LiveRun) -> None:
    """Mark a run as active, and register it.

    In a folder that cannot be written there is no mark: `read` ignores that run.
    """
    with suppress(OSError):
        write_whole(folder / _FILE, msgspec.json.encode(run))
    register_of_active_runs.add(folder)


def remove(folder: Path) -> None:
    """Mark the run of a folder as ended."""
    register_of_active_runs.remove(folder)
    with suppress(OSError):
        (folder / _FILE).unlink()


def read(folder: Path) -> LiveRun | None:
    """Return the active run of a folder, or None.

    The file of a killed run, or with other content, is ignored.
    """
    try:
        run = msgspec.json.decode((folder / _FILE).read_bytes(), type=LiveRun)
    except (OSError, msgspec.MsgspecError):
        return None
    return run if _is_running(run.pid) else None


def _is_running(pid: int) -> bool:
    """Return whether a process runs; one that has ended may wait for its parent to notice."""
    try:
        status: str = psutil.Process(pid).status()
    except psutil.Error:
        return False
    return status != str(psutil.STATUS_ZOMBIE)


def newest_folder(parent: Path) -> Path | None:
    """Return the folder of the most recent active run below a folder.

    Without one below it is the most recent of this user anywhere.
    """
    below = [path for path in parent.glob("*") if not path.is_symlink()]
    return _newest(below) or _newest(register_of_active_runs.folders())


def _newest(folders: Iterable[Path]) -> Path | None:
    """Return the folder whose run became active last; None if none is active."""
    began_ns: dict[Path, int] = {}
    for folder in folders:
        with suppress(OSError):  # the folder has gone meanwhile
            if read(folder) is not None:
                began_ns[folder] = (folder / _FILE).stat().st_mtime_ns
    return max(began_ns, key=lambda folder: began_ns[folder], default=None)


def request(
    run: str,
    endpoints: Sequence[str],
    name: str,
    what: str,
    given: Mapping[str, Any],
    keys: Path | None = None,
) -> dict[str, Any]:
    """Send a request (docs/reference/protocol.md) to a process of a run and return the answer.

    `keys` is the folder of the run's keys.

    Raises: BusError: it does not exist or does not answer. TransportError: it refuses the request.
    """
    security = None if keys is None else Security(keys.resolve(), (name, ROUTER))
    reach = Reach(connect=endpoints, security=security)
    answer = dict(ask(run, reach, name, what, given))
    if "error" in answer:
        raise TransportError(str(answer["error"]))
    return answer


class Commands:
    """Requests to one live run, sent by a thread.

    `on_result` gets a sentence about each, and whether it was refused.
    """

    def __init__(self, run: LiveRun, on_result: Callable[[str, bool], None]) -> None:
        self._run = run
        self._on_result = on_result
        self._requests: queue.SimpleQueue[tuple[str, str, Mapping[str, Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._send_requests, name="commands", daemon=True).start()

    def link(self, ends: tuple[int, int] | None, settings: Mapping[str, Any]) -> None:
        """Change the link from one agent to another, or, for None, all links between agents."""
        source, target = map(agent_name, ends) if ends else ("", "")
        change = {"from": source, "to": target, "settings": settings}
        self._requests.put((COORDINATOR, "link", change))

    def cut(self, groups: Sequence[Sequence[int]]) -> None:
        """Lose all messages between groups of agents, in both directions, all from one tick on."""
        names = [[agent_name(agent) for agent in group] for group in groups]
        self._requests.put((COORDINATOR, "link", {"groups": names, "settings": {"loss": 1.0}}))

    def clear(self) -> None:
        """Make all links perfect, those of the plant included."""
        self._requests.put((COORDINATOR, "link", {"all": True, "settings": PERFECT}))

    def target(self, place: Array, to: Sequence[int] = ()) -> None:
        """Send the payload to a position, (3,), inertial frame, m, of which some agents are told, or all."""
        told = {"to": [*to]} if to else {}
        self._requests.put((COORDINATOR, "target", {"points_m": [place.tolist()], **told}))

    def land(self) -> None:
        """Let the team come down where it is."""
        self._requests.put((COORDINATOR, "target", {"land": True}))

    def fault(self, action: str, target: str) -> None:
        """Kill or restart a process."""
        self._requests.put((RECORDER, "fault", {"do": action, "target": target}))

    def _send_requests(self) -> None:
        """Send each request and pass on its result, without end."""
        while True:
            name, kind, content = self._requests.get()
            try:
                answer = self._run.ask(name, kind, content)
            except TransportError as error:
                self._on_result(str(error), True)
                continue
            self._on_result(_result_in_words(kind, content, answer), False)


def _result_in_words(kind: str, content: Mapping[str, Any], answer: Mapping[str, Any]) -> str:
    """Return a sentence about a request that was accepted."""
    if kind == "target":
        what = "landing" if content.get("land") else "target"
        told = "".join(f", told to {agent_name(agent)}" for agent in content.get("to", ()))
        place = f"{what} " + "({:g}, {:g}, {:g}) m".format(*answer["point_m"]) + told
        duration_s = answer["ends_s"] - answer["t_s"]
        return f"{place}: arrives at t = {answer['ends_s']:.1f} s, in {duration_s:.1f} s"
    if kind == "link":
        return f"links change: at tick {answer['tick']}"
    return f"{content.get('do')} {content.get('target')}: at tick {answer['tick']}"
