"""What people do to a run in flight from the viewer: the requests of `transport link` and `transport fault`."""

import queue
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from protocol.wire.messages import agent_name
from transport.flight.live import LiveRun
from transport.flight.requests import PERFECT, RefusedError, UnansweredError, request


class Commands:
    """Asks one run for things, one after the other, on a thread of its own.

    Args:
        run: That flies.
        say: Called with what came of it, and whether it was refused.
    """

    def __init__(self, run: LiveRun, say: Callable[[str, bool], None]) -> None:
        self._run, self._say = run, say
        self._waiting: queue.SimpleQueue[tuple[str, str, Mapping[str, Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="acts", daemon=True).start()

    def link(self, ends: tuple[int, int] | None, settings: Mapping[str, Any]) -> None:
        """Change a link, by its sender and receiver, or all links between agents."""
        source, target = ("", "") if ends is None else (agent_name(ends[0]), agent_name(ends[1]))
        self._waiting.put(("coordinator", "link", {"from": source, "to": target, "settings": settings}))

    def clear(self) -> None:
        """Make all links perfect, the plant's as well."""
        for ends in ({}, {"from": "plant"}, {"to": "plant"}):
            self._waiting.put(("coordinator", "link", {**ends, "settings": PERFECT}))

    def fault(self, action: str, target: str) -> None:
        """Kill or restart a process."""
        self._waiting.put(("recorder", "fault", {"do": action, "target": target}))

    def _work(self) -> None:
        while True:
            name, what, given = self._waiting.get()
            try:
                keys = Path(self._run.keys) if self._run.keys else None
                answer = request(self._run.run, [self._run.endpoints[name]], name, what, given, keys)
            except (RefusedError, UnansweredError) as error:
                self._say(str(error), True)
                continue
            done = f"{given['do']} {given['target']}" if what == "fault" else "links change"
            self._say(f"{done}: at tick {answer['tick']}", False)
