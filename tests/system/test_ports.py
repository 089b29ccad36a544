"""Ports of simultaneous runs: all are different, and no other process gets one."""

import socket
import sys
from contextlib import ExitStack, closing

import pytest

from transport.flight.local_processes import HarnessError, reserved_ports

HOST = "127.0.0.1"

# Simultaneous runs, ports of each, and concurrent requests for any port; Linux has 28 000 such
# ports.
RUNS, PORTS, OTHERS = 20, 8, 10_000


# Elsewhere a reserved port would be blocked for the processes of the run as well.
linux = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux shares a port without a listener"
)


def any_port(shares: bool) -> int:
    """Return the port that the system assigns to a process without a preference."""
    with closing(socket.socket()) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(shares))
        other.bind((HOST, 0))
        port: int = other.getsockname()[1]
        return port


@linux
def test_ports_are_kept() -> None:
    """Reserved ports are all different.

    Neither a request for any port nor an outgoing connection gets one.
    """
    with ExitStack() as reserved, closing(socket.create_server((HOST, 0))) as server:
        kept = [
            port
            for _ in range(RUNS)
            for port in reserved.enter_context(reserved_ports(HOST, [0] * PORTS))
        ]
        assert len(set(kept)) == RUNS * PORTS
        assert not {any_port(number % 2 == 0) for number in range(OTHERS)} & set(kept)
        for _ in range(OTHERS // 10):
            with closing(socket.create_connection(server.getsockname())) as caller:
                assert caller.getsockname()[1] not in kept
            server.accept()[0].close()


def test_an_address_of_another_machine() -> None:
    """An address of another machine is refused with its key."""
    stranger = "203.0.113.1"
    with (
        pytest.raises(HarnessError, match=r"network\.host: cannot listen on 203"),
        reserved_ports(stranger, [0]),
    ):
        pass
