"""Zenoh sessions: their configuration, and a router."""

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any

import zenoh

from transport.protocol.network.endpoints import Endpoints
from transport.protocol.wire.codec import MAX_BYTES
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE, TransportError
from transport.protocol.wire.key_expressions import ROUTER, Keys

_RETRY_S = 0.05  # pause between attempts of a client to reach its router
# Length of the first attempt of a client, and the longest: each takes twice as long as the one before,
# as a process on a starved host may need seconds for its part of the handshake.
_ATTEMPT_MS, _LONGEST_MS = 500, 2000
_FOR_EVER = -1  # of a peer
# Pauses between attempts to connect to an address, growing by a factor: peers of a run start together.
_RETRIES = {"period_init_ms": 5, "period_max_ms": 200, "period_increase_factor": 1.5}
CLOSE_S = 2.0  # how long closing may take: it blocks while a peer does not read (zenoh issue 2675)


class BusError(TransportError, RuntimeError):
    """The network cannot be used: the text says what was tried and what to do."""

    exit_code = EXIT_UNREACHABLE


_first_user = 0  # process id of the process that opened the first session


def is_used() -> bool:
    """Whether a session has been opened in this process, or in one of which it is a fork."""
    return _first_user != 0


def check_usable() -> None:
    """Raise BusError in a process that was forked from one that has opened a session."""
    if _first_user not in (0, os.getpid()):
        raise BusError(
            "this process was forked from one that has used the network, whose threads do not "
            "survive a fork: start it by 'spawn' (multiprocessing.get_context('spawn')), or run in "
            "memory"
        )


def open_session(
    endpoints: Endpoints, patience_s: float, name: str, keys: Keys, reach_s: float
) -> zenoh.Session:
    """Open the session of a process.

    It waits `patience_s` for peers that do not read, and a client `reach_s` for its router.

    Raises: BusError: the endpoint cannot be listened on, or the router not reached. SecurityError:
        unusable keys.
    """
    global _first_user
    check_usable()
    _first_user = os.getpid()
    settings = configuration(endpoints, patience_s, name, keys)
    deadline = time.monotonic() + reach_s
    while True:
        text = json.dumps(settings, ensure_ascii=False)
        try:
            return zenoh.open(zenoh.Config.from_json5(text))
        except zenoh.ZError as error:
            is_client = endpoints.mode == "client"
            if is_client and time.monotonic() <= deadline:
                time.sleep(_RETRY_S)
                attempt_ms = settings["connect"]["timeout_ms"]
                settings["connect"]["timeout_ms"] = min(2 * attempt_ms, _LONGEST_MS)
                continue
            problem = (
                _no_connection(name, endpoints) if is_client else _cannot_listen(endpoints, error)
            )
            raise BusError(problem) from error


def _no_connection(name: str, endpoints: Endpoints) -> str:
    """Return the text of the error of a client without a router, or the process that it asks."""
    return f"{name}: no process accepts a connection at {', '.join(endpoints.connect)}"


def _cannot_listen(endpoints: Endpoints, error: zenoh.ZError) -> str:
    """Return the text of the error of a process that cannot listen."""
    problem = f"cannot listen ({error!s:.200})"
    if "in use" in str(error):
        problem = "address already in use; choose another base port, or end the process that has it"
    return f"{', '.join(endpoints.listen)}: {problem}"


def configuration(endpoints: Endpoints, patience_s: float, name: str, keys: Keys) -> dict[str, Any]:
    """Return Zenoh's configuration of a process with fixed endpoints and without discovery.

    A peer tries to connect as long as its session is open. A client tries once: `open_session`
    repeats that.
    """
    settings: dict[str, Any] = {
        "mode": endpoints.mode,
        "listen": {"endpoints": list(endpoints.listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(endpoints.connect),
            # `open_session` repeats a client's attempts, so that Ctrl-C can end them.
            "timeout_ms": _ATTEMPT_MS if endpoints.mode == "client" else _FOR_EVER,
            "exit_on_failure": endpoints.mode == "client",
            "retry": _RETRIES,
        },
        "transport": {
            "link": {
                "rx": {"max_message_size": 2 * MAX_BYTES},  # larger ones are dropped uncounted
                "tx": {
                    "queue": {
                        "congestion_control": {
                            "block": {"wait_before_close": round(patience_s * 1e6)}
                        }
                    }
                },
            },
            # Zenoh keeps its segments until the process ends, and leaves them in /dev/shm when it
            # is killed.
            "shared_memory": {"enabled": False},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    if endpoints.security is not None:
        endpoints.security.configure(settings, name, keys.prefix)
    return settings


@contextmanager
def session_of(
    endpoints: Endpoints, name: str, keys: Keys, reach_s: float
) -> Iterator[zenoh.Session]:
    """Open a session of a client or a router, and close it in bounded time."""
    session = open_session(endpoints, 1.0, name, keys, reach_s)
    try:
        yield session
    finally:
        in_bounded_time(session.close)


def route(endpoints: Endpoints) -> AbstractContextManager[zenoh.Session]:
    """Route the messages of the clients of any run while the context is open.

    Raises: BusError: as `open_session`.
    """
    log_errors(to_output=True)
    return session_of(endpoints, ROUTER, Keys.below("transport/*"), 0.0)


def log_errors(*, to_output: bool) -> None:
    """Let Zenoh write its errors to standard output.

    Otherwise it writes only what the variable RUST_LOG asks for: standard output of many commands is
    for their results.
    """
    if to_output:
        zenoh.init_log_from_env_or("error")
    else:
        zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]


def in_bounded_time(*closing: Callable[[], Any]) -> None:
    """Call closing functions; return after `CLOSE_S` even if they are blocked.

    A peer that does not read blocks them.
    """

    def run() -> None:
        for close in closing:
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
