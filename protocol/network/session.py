"""Zenoh sessions of a run: where they listen and whom they call, their configuration, questions and answers, a router.

All of Zenoh's configuration is here; what a process does with its session is in `protocol.network.bus`.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import zenoh

from protocol.network.endpoints import Endpoints
from protocol.network.security import Security, SecurityError
from protocol.wire.codec import MAX_BYTES
from protocol.wire.keys import ACTING, OPERATOR, ROUTER, WATCHER, Keys

# Closing can block for as long as a peer does not read (zenoh issue 2675); a process that has said all it
# had to say does not wait for that longer than this.
CLOSE_S = 2.0

# What Zenoh puts together for us at most; from the gate's limit up to here it is counted, beyond it just dropped.
_MAX_RECEIVED_BYTES = 2 * MAX_BYTES

# How long a client tries to connect at a time.
_TRY_MS = 500


class BusError(RuntimeError):
    """The network cannot be used: the text says what was tried and what to do."""


def open_session(endpoints: Endpoints, patience_s: float, name: str, keys: Keys, reach_s: float) -> zenoh.Session:
    """A session under a name.

    Raises: BusError: the endpoint cannot be listened on, the router not reached, or the keys not used.
    """
    try:
        text = json.dumps(configuration(endpoints, patience_s, name, keys))
    except SecurityError as error:
        raise BusError(str(error)) from error
    deadline = time.monotonic() + reach_s
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(text))
        except zenoh.ZError as error:
            if endpoints.mode != "client":
                raise BusError(_listen_problem(endpoints, str(error))) from error
            if time.monotonic() > deadline:
                where = ", ".join(endpoints.connect)
                raise BusError(
                    f"{name}: no router lets it in at {where} within {reach_s:g} s ({str(error)[:200]})"
                ) from error


def configuration(endpoints: Endpoints, patience_s: float, name: str, keys: Keys) -> dict[str, Any]:
    """Zenoh's configuration of a process: fixed endpoints, no discovery, fast retries, patience until `join` gives up.

    Args:
        endpoints: Where it is, with which keys.
        patience_s: How long sending may wait for a peer that does not read.
        name: The process's.
        keys: Key expressions of its run.
    Raises: SecurityError: keys that it cannot use.
    """
    found: dict[str, Any] = {
        "mode": endpoints.mode,
        "listen": {"endpoints": list(endpoints.listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(endpoints.connect),
            # A client is nothing without its router, and tries again by itself (`open_session`), where Ctrl-C is heard.
            "timeout_ms": _TRY_MS if endpoints.mode == "client" else -1,
            "exit_on_failure": endpoints.mode == "client",
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "transport": {
            "link": {
                "rx": {"max_message_size": _MAX_RECEIVED_BYTES},
                "tx": {"queue": {"congestion_control": {"block": {"wait_before_close": round(patience_s * 1e6)}}}},
            }
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    if endpoints.security is not None:
        secure = endpoints.security.configuration(name, keys.prefix, mode=endpoints.mode)
        transport = secure["transport"]
        found["transport"]["link"] |= transport.pop("link", {})
        found["transport"] |= transport
        found |= {key: value for key, value in secure.items() if key != "transport"}
    return found


def _listen_problem(endpoints: Endpoints, detail: str) -> str:
    where = ", ".join(endpoints.listen)
    if "in use" in detail:
        return f"{where}: address already in use; choose another base port, or end the process that has it"
    return f"{where}: cannot listen ({detail[:200]})"


def ask(
    run: str,
    connect: Sequence[str],
    name: str,
    what: str,
    given: Mapping[str, Any],
    timeout_s: float = 5.0,
    security: Security | None = None,
) -> Mapping[str, Any]:
    """Ask a process of a run for something, from outside.

    Args:
        run: Name of the run.
        connect: Endpoints of its processes, or of their router.
        name: Process to ask.
        what: Request; see docs/protocol.md.
        given: Its arguments.
        timeout_s: How long to look for the process, and how long to wait for its answer.
        security: Keys of who asks, an operator or, for what changes nothing, a watcher.
    Raises: BusError: there is no such process, or it does not answer.
    """
    keys = Keys(run)
    log_errors(to_output=False)
    # One endpoint may be a process or a router; a client is at home with both.
    endpoints = Endpoints(listen=[], connect=connect, mode="client" if len(connect) == 1 else "peer", security=security)
    deadline = time.monotonic() + timeout_s
    session = open_session(endpoints, 1.0, OPERATOR if what in ACTING else WATCHER, keys, timeout_s)
    try:
        while not any(reply.ok for reply in session.liveliness().get(f"{keys.prefix}/alive/{name}/**", timeout=1.0)):
            if time.monotonic() > deadline:
                raise BusError(f"no sign of {name} of run {run} within {timeout_s:g} s; tried {', '.join(connect)}")
            time.sleep(0.02)
        answer = fetch_answer(session, keys.request(name, what), given, timeout_s)
    finally:
        in_bounded_time(session.close)
    if answer is None:
        raise BusError(f"{name} of run {run} does not answer")
    return answer


@contextmanager
def route(endpoints: Endpoints) -> Iterator[None]:
    """Pass on what the clients of any run say to each other, as long as the context is open.

    Args:
        endpoints: Where to listen, and other routers to call.
    Raises: BusError: the endpoint cannot be listened on, or the keys not used.
    """
    log_errors(to_output=True)
    session = open_session(endpoints, 1.0, ROUTER, Keys.below("transport/*"), 0.0)
    try:
        yield
    finally:
        in_bounded_time(session.close)


def log_errors(*, to_output: bool) -> None:
    """Let Zenoh write its errors to standard output, or leave that to RUST_LOG where a command's results go there."""
    if to_output:
        zenoh.init_log_from_env_or("error")
    else:
        zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]


def in_bounded_time(close: Callable[[], Any]) -> None:
    """Close something, or leave it to the end of the process when a peer that does not read holds it up."""

    def run() -> None:
        with suppress(zenoh.ZError):  # "timed out"
            close()

    closer = threading.Thread(target=run, daemon=True)
    closer.start()
    closer.join(CLOSE_S)


def fetch_answer(
    session: zenoh.Session, key: str, request: Mapping[str, Any], timeout_s: float
) -> Mapping[str, Any] | None:
    """Return the answer to a request, or None if there is none in time."""
    for reply in session.get(key, payload=json.dumps(request), timeout=timeout_s):
        if reply.ok is not None:
            answer: Mapping[str, Any] = json.loads(reply.ok.payload.to_string())
            return answer
    return None
