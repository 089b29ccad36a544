"""Requests to a process from the network: asked from outside its run, and answered by it or its node."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import psutil
import zenoh

from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.security import Security
from transport.protocol.network.session import BusError, fetch_answer, log_errors, session_of
from transport.protocol.wire.codec import VERSION
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import ACTING, OPERATOR, WATCHER, Keys
from transport.protocol.wire.messages import Request

_LOOK_S = 0.02  # pause between looks for the token of a process


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How a process is reached from outside its run.

    Attributes:
        connect: Endpoints; a single one may be of the process or of a router.
        security: Keys of the client.
        timeout_s: Time to find the process, and again for its answer, s; by default that after which
            Zenoh takes a silent process for gone: one that is frozen for less goes on with the run.
    """

    connect: Sequence[str]
    security: Security | None = None
    timeout_s: float = 10.0


def ask(
    run: str, reach: Reach, name: str, what: str, given: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Send a request to a process from outside its run (docs/reference/protocol.md), and return the answer.

    The client is an operator or, for requests that change nothing, a watcher.

    Raises: BusError: there is no such process, or it does not answer in time.
    """
    keys = Keys(run)
    timeout_s = reach.timeout_s
    deadline = time.monotonic() + timeout_s
    whom = f"{name} of run {run}"
    client = OPERATOR if what in ACTING else WATCHER
    log_errors(to_output=False)

    # A client can connect to a process or to a router.
    mode: Literal["client", "peer"] = "client" if len(reach.connect) == 1 else "peer"
    endpoints = Endpoints(listen=[], connect=reach.connect, mode=mode, security=reach.security)
    try:
        with session_of(endpoints, client, keys, timeout_s) as session:
            token = f"{keys.prefix}/alive/{name}/**"
            while not any(reply.ok for reply in session.liveliness().get(token, timeout=1.0)):
                if time.monotonic() > deadline:
                    places = ", ".join(reach.connect)
                    raise BusError(f"no sign of it within {timeout_s:g} s at {places}")
                time.sleep(_LOOK_S)
            answer = fetch_answer(session, keys.request(name, what), given, timeout_s)
    except BusError as error:
        raise BusError(
            f"{whom} is not reachable, it has ended or uses other keys: {error}"
        ) from error
    except zenoh.ZError as error:  # its text is about Zenoh's sources
        raise BusError(
            f"{whom} has closed the connection: it has ended, or is about to end"
        ) from error
    if answer is None:
        raise BusError(
            f"{whom} does not answer within {timeout_s:g} s: it is stopped, or its host is too busy; "
            "it may still do later what was asked"
        )
    return answer


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
