"""Requests from the network: answered for the process, or returned for its node."""

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import psutil
import zenoh

from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.wire.codec import VERSION
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Request


class Requests:
    """Requests to one process: all answer for their health, and `serves` says whether its node does."""

    def __init__(self, name: str, keys: Keys, gate: Gate, *, serves: bool) -> None:
        self._name = name
        self._keys = keys
        self._gate = gate
        self._serves = serves

    def take(self, query: zenoh.Query, incarnation: int) -> Request | None:
        """Return a request as an event for the node, or None if it is answered here.

        Bad ones are, and those for the health of this process, in its incarnation.
        """
        key = str(query.key_expr)
        what = key.removeprefix(self._keys.request(self._name, ""))

        def reply(answer: Mapping[str, Any]) -> None:
            query.reply(key, json.dumps(answer))
            query.drop()  # type: ignore[no-untyped-call]

        given = None
        with suppress(ValueError, RecursionError, zenoh.ZError):
            given = json.loads(query.payload.to_string() if query.payload else "{}")
        if not isinstance(given, dict) or "/" in what or "*" in what:
            error = MessageError("malformed", "not a request")
            self._gate.rejections.add(self._keys.end(key), error)
            reply({"error": "expected a JSON object under the key of one request"})
            return None
        if what == "health":
            reply(self._health(incarnation))
            return None
        if not self._serves:
            expected = f"expected health, the only request that {self._name} answers"
            reply({"error": f"what: {expected}, got {what[:40]!r}"})
            return None
        return Request(what, given, reply)

    def _health(self, incarnation: int) -> dict[str, Any]:
        """Return the resource use of this process, and how many messages it has refused."""
        process = psutil.Process()
        return {
            "name": self._name,
            "incarnation": incarnation,
            "protocol": VERSION,
            "tick": self._gate.tick,
            "refused": self._gate.rejections.total,
            "memory_bytes": process.memory_info().rss,
            "threads": process.num_threads(),
            "open_files": process.num_fds(),
            "cpu_s": time.process_time(),
        }
