"""Sessions: opening and closing; endpoints in words, and in the configuration."""

import os
import socket
import threading
from typing import Any

import pytest
import zenoh

from transport.protocol.network import session
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import (
    BusError,
    configuration,
    in_bounded_time,
    open_session,
)
from transport.protocol.wire.key_expressions import Keys


def test_all_is_closed_although_one_part_fails() -> None:
    """A subscriber that cannot be undeclared leaves no session open."""
    closed = []

    def fail() -> None:
        raise zenoh.ZError("timed out")

    in_bounded_time(fail, lambda: closed.append("session"))
    assert closed == ["session"]


def test_a_peer_that_does_not_read_delays_the_end_for_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Closing goes on in the background."""
    monkeypatch.setattr(session, "CLOSE_S", 0.01)
    reads = threading.Event()
    closed: list[str] = []
    in_bounded_time(reads.wait, lambda: closed.append("session"))
    assert closed == []
    reads.set()


class Keyed:
    """Keys that note for which process and run they are used."""

    @staticmethod
    def configure(configuration: dict[str, Any], name: str, prefix: str) -> None:
        """Add the access control of a process."""
        configuration["access_control"] = name, prefix


def test_a_session_uses_the_keys_it_is_given() -> None:
    """They are those of the process, for the expressions of its run."""
    keyed: Any = Keyed()
    endpoints = Endpoints(listen=[], connect=[], security=keyed)
    found = configuration(endpoints, 0.1, "agent1", Keys("run"))
    assert found["access_control"] == ("agent1", "transport/run")


def test_endpoints_in_words_have_no_empty_part() -> None:
    """A client of a router does not listen, and the first of a list connects to none."""
    one, other = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448"
    both = Endpoints(listen=[one], connect=[one, other]).in_words()
    assert both == f"listens on {one}, connects to {one}, {other}"
    assert Endpoints(listen=[], connect=[one], mode="client").in_words() == f"connects to {one}"
    assert Endpoints(listen=[one], connect=[]).in_words() == f"listens on {one}"


def test_a_peer_waits_for_others_and_a_client_tries_once() -> None:
    """A peer keeps trying to connect, a client fails, to be repeated; both find only what they are given.

    A peer that does not read delays the others by the patience, which Zenoh takes in microseconds.
    """
    place = "tcp/127.0.0.1:7447"
    for mode, timeout_ms, fails in (("peer", -1, False), ("client", 500, True)):
        endpoints = Endpoints(listen=[], connect=[place], mode=mode)  # type: ignore[arg-type]
        found = configuration(endpoints, 0.1, "agent1", Keys("run"))
        assert (found["mode"], found["connect"]["endpoints"]) == (mode, [place])
        assert (found["connect"]["timeout_ms"], found["connect"]["exit_on_failure"]) == (
            timeout_ms,
            fails,
        )
        congestion = found["transport"]["link"]["tx"]["queue"]["congestion_control"]
        assert congestion == {"block": {"wait_before_close": 100_000}}
        assert found["scouting"]["delay"] == 0  # else each session waits for others to be found
        for discovery in ("multicast", "gossip"):
            assert found["scouting"][discovery] == {"enabled": False}
        # Peers of a run start together; a lost segment of shared memory would outlive a process.
        retry = found["connect"]["retry"]
        assert retry["period_init_ms"] < retry["period_max_ms"] <= 200
        assert retry["period_increase_factor"] > 1.0
        assert found["transport"]["shared_memory"] == {"enabled": False}


def test_a_process_that_cannot_use_the_network_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its port is in use, or it is a fork of a process whose threads are not in it."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        endpoints = Endpoints(listen=[taken], connect=[])
        with pytest.raises(BusError, match=f"{taken}: address already in use; choose another base"):
            open_session(endpoints, 1.0, "plant", Keys("run"), 0.0)
    monkeypatch.setattr(session, "_first_user", os.getpid() + 1)
    with pytest.raises(BusError, match=r"forked from one that has used the network.*'spawn'"):
        open_session(endpoints, 1.0, "plant", Keys("run"), 0.0)
