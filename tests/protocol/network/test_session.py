"""Sessions: what is closed although something else fails to; endpoints in words."""

import zenoh

from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.session import in_bounded_time


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
