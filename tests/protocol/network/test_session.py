"""Sessions: opening, requests from outside, closing; endpoints in words, and in the configuration."""

import os
import socket
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from transport.protocol.network import session
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import (
    BusError,
    Reach,
    ask,
    configuration,
    fetch_answer,
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


def reply(answer: str | None) -> Any:
    """Return a reply of Zenoh; None: one of an error."""
    if answer is None:
        return SimpleNamespace(ok=None)
    return SimpleNamespace(ok=SimpleNamespace(payload=SimpleNamespace(to_string=lambda: answer)))


class Asked:
    """A session of a client that finds a process, or none, and gets some replies of it."""

    def __init__(self, replies: Sequence[str | None], *, is_there: bool = True) -> None:
        self.replies = replies
        self.is_there = is_there
        self.opened: tuple[str, str] | None = None

    def open(self, endpoints: Endpoints, _patience_s: float, name: str, *_: object) -> "Asked":
        """Return this session as that of a client."""
        self.opened = endpoints.mode, name
        return self

    def liveliness(self) -> "Asked":
        """Return what tells of processes."""
        return self

    def get(self, _key: str, payload: str | None = None, timeout: float = 0.0) -> list[Any]:
        """Return the replies to a request, or of a search for a process."""
        if payload is None:
            return [reply("")] if self.is_there else [reply(None)]
        return [reply(one) for one in self.replies]

    def close(self) -> None:
        """Close."""


@pytest.mark.parametrize(
    ("replies", "answer"),
    [
        ([], None),
        ([None], None),
        ([None, '{"tick": 3}'], {"tick": 3}),
        (['{"tick": 3}', '{"tick": 4}'], {"tick": 3}),
    ],
)
def test_the_first_answer_that_is_no_error_counts(
    replies: list[str | None], answer: dict[str, int] | None
) -> None:
    """A router replies with an error for a process that is gone; without another reply there is none."""
    asked: Any = Asked(replies)
    assert fetch_answer(asked, "key", {}, 1.0) == answer


@pytest.mark.parametrize(
    ("places", "what", "mode", "client"),
    [
        (1, "status", "client", "watcher"),
        (2, "status", "peer", "watcher"),
        (1, "link", "client", "operator"),
    ],
)
def test_a_client_has_the_rights_that_its_request_needs(
    places: int, what: str, mode: str, client: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only requests that change the run are those of an operator; one place may be a router."""
    asked = Asked(["{}"])
    monkeypatch.setattr(session, "open_session", asked.open)
    reach = Reach(connect=["tcp/127.0.0.1:7447"] * places)
    assert ask("run", reach, "coordinator", what, {}) == {}
    assert asked.opened == (mode, client)


@pytest.mark.parametrize(
    ("asked", "problem"),
    [
        (
            Asked([], is_there=False),
            "is not reachable.*no sign of it within 0 s at tcp/plant:1, tcp/b:2",
        ),
        (Asked([None]), "does not answer within 0 s: it is stopped, or its host is too busy"),
    ],
)
def test_a_request_without_an_answer_has_its_reason(
    asked: Asked, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is not there is told from one that does not answer."""
    monkeypatch.setattr(session, "open_session", asked.open)
    with pytest.raises(BusError, match=f"^plant of run r {problem}"):
        ask("r", Reach(connect=["tcp/plant:1", "tcp/b:2"], timeout_s=0.0), "plant", "health", {})


def test_a_connection_that_closes_meanwhile_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The text of Zenoh's error is about its sources."""

    def closed(*_: object) -> Asked:
        raise zenoh.ZError("src/api/session.rs")

    monkeypatch.setattr(session, "open_session", closed)
    with pytest.raises(BusError, match=r"^plant of run r has closed the connection") as refused:
        ask("r", Reach(connect=["tcp/plant:1"]), "plant", "health", {})
    assert "session.rs" not in str(refused.value)
