"""Sessions: what is closed although something else fails to."""

import zenoh

from transport.protocol.network.session import in_bounded_time


def test_all_is_closed_although_one_part_fails() -> None:
    """A subscriber that cannot be undeclared leaves no session open."""
    closed = []

    def fail() -> None:
        raise zenoh.ZError("timed out")

    in_bounded_time(fail, lambda: closed.append("session"))
    assert closed == ["session"]
