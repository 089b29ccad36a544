"""Requests to an active run from programs that go on meanwhile: the viewer, the bridge to ROS 2."""

import queue
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from model.arrays import Array
from protocol.scenario.links import PERFECT
from protocol.wire.messages import agent_name
from protocol.wire.names import COORDINATOR, PLANT, RECORDER
from transport.flight.live import LiveRun, RefusedError, UnansweredError, request

_CHANGED = {"link": "links change", "target": "target changes"}


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
            done = f"{content['do']} {content['target']}" if kind == "fault" else _CHANGED[kind]
            self._on_result(f"{done}: at tick {answer['tick']}", False)
