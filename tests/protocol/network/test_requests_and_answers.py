"""Requests: the answers that clients get, and those that processes give."""

import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from tests.support.runs import setup
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network import requests_and_answers
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.requests_and_answers import Reach, Requests, ask
from transport.protocol.network.session import BusError, fetch_answer
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Request

KEYS = Keys("r")


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

    def open(self, endpoints: Endpoints, name: str, *_: object) -> "Asked":
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

    def __enter__(self) -> "Asked":
        return self

    def __exit__(self, *_: object) -> None:
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
    monkeypatch.setattr(requests_and_answers, "session_of", asked.open)
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
    monkeypatch.setattr(requests_and_answers, "session_of", asked.open)
    with pytest.raises(BusError, match=f"^plant of run r {problem}"):
        ask("r", Reach(connect=["tcp/plant:1", "tcp/b:2"], timeout_s=0.0), "plant", "health", {})


def test_a_connection_that_closes_meanwhile_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The text of Zenoh's error is about its sources."""

    def closed(*_: object) -> Asked:
        raise zenoh.ZError("src/api/session.rs")

    monkeypatch.setattr(requests_and_answers, "session_of", closed)
    with pytest.raises(BusError, match=r"^plant of run r has closed the connection") as refused:
        ask("r", Reach(connect=["tcp/plant:1"]), "plant", "health", {})
    assert "session.rs" not in str(refused.value)


class Query:
    """A request as Zenoh hands it over, and the answers to it."""

    def __init__(self, what: str, given: str | None) -> None:
        self.key_expr = KEYS.request("plant", what)
        self.payload = None if given is None else SimpleNamespace(to_string=lambda: given)
        self.answers: list[dict[str, Any]] = []

    def reply(self, key: str, answer: str) -> None:
        """Take an answer."""
        assert key == self.key_expr
        self.answers.append(json.loads(answer))

    def drop(self) -> None:
        """End the request."""


NO_REQUEST = "expected a JSON object under the key of one request"


@pytest.mark.parametrize(
    ("what", "given", "serves", "error", "refused"),
    [
        ("status", "{", True, NO_REQUEST, 1),
        ("status", "[]", True, NO_REQUEST, 1),
        ("status", "[" * 100_000, True, NO_REQUEST, 1),
        ("*", "{}", True, NO_REQUEST, 1),
        ("link/1", "{}", True, NO_REQUEST, 1),
        ("status", "{}", False, "what: expected health, the only request that plant answers", 0),
        ("health", None, False, "", 0),
    ],
)
def test_a_process_answers_itself_what_its_node_does_not(
    what: str, given: str | None, serves: bool, error: str, refused: int
) -> None:
    """Bad requests, which are counted, those to a process that serves none, and those for its health."""
    gate = Gate("plant", KEYS, setup().rules.shape)
    query: Any = Query(what, given)
    assert Requests("plant", KEYS, gate, serves=serves).take(query, 3) is None
    (answer,) = query.answers
    assert answer.get("error", "").startswith(error)
    if not error:
        assert (answer["name"], answer["incarnation"], answer["refused"]) == ("plant", 3, 0)
    assert gate.rejections.total == refused


def test_a_request_for_the_node_is_an_event_that_it_answers() -> None:
    """The event has what is asked for, and the arguments."""
    gate = Gate("plant", KEYS, setup().rules.shape)
    query: Any = Query("link", '{"groups": []}')
    request = Requests("plant", KEYS, gate, serves=True).take(query, 0)
    assert isinstance(request, Request)
    assert (request.what, request.given, query.answers) == ("link", {"groups": []}, [])
    request.reply({"tick": 7})
    assert query.answers == [{"tick": 7}]
