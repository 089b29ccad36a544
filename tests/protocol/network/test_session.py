"""Sessions: what is closed although something else fails to; endpoints in words, and in the configuration."""

import zenoh

from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import configuration, in_bounded_time
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
        for discovery in ("multicast", "gossip"):
            assert found["scouting"][discovery] == {"enabled": False}
