"""Ports of runs started at the same instant: no two get the same, and nobody else is given one."""

import socket
import sys
from contextlib import ExitStack, closing

import pytest

from transport.flight.harness import HarnessError, free_ports

HOST = "127.0.0.1"

# Runs at once, ports of each, and how often others ask for any port meanwhile: of 28 000 there are on Linux.
RUNS, PORTS, OTHERS = 20, 8, 10_000


# Elsewhere a port that is kept would be kept from the processes of the run as well.
linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux shares a port that nobody listens on")


def any_port(shares: bool) -> int:
    """The port that somebody gets who asks for any."""
    with closing(socket.socket()) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(shares))
        other.bind((HOST, 0))
        port: int = other.getsockname()[1]
        return port


@linux
def test_ports_are_kept() -> None:
    """While runs fly their ports are all different, and neither who asks for any port nor who calls gets one."""
    with ExitStack() as flying, closing(socket.create_server((HOST, 0))) as server:
        kept = [port for _ in range(RUNS) for port in flying.enter_context(free_ports(HOST, PORTS))]
        assert len(set(kept)) == RUNS * PORTS
        assert not {any_port(number % 2 == 0) for number in range(OTHERS)} & set(kept)
        for _ in range(OTHERS // 10):
            with closing(socket.create_connection(server.getsockname())) as caller:
                assert caller.getsockname()[1] not in kept
            server.accept()[0].close()


def test_its_process_listens_again_and_again() -> None:
    """A process can listen on its port while it is kept, and so can the one that is started in its place."""
    with free_ports(HOST, 1) as (port,):
        for _ in range(2):
            with closing(socket.create_server((HOST, port))) as server:
                with closing(socket.create_connection((HOST, port))):
                    server.accept()[0].close()
                with pytest.raises(OSError, match="in use"):
                    socket.create_server((HOST, port))


def test_an_address_of_another_machine() -> None:
    """An address that is not this machine's is refused with the key it comes from."""
    stranger = "203.0.113.1"
    with pytest.raises(HarnessError, match=r"network\.host: cannot listen on 203"), free_ports(stranger, 1):
        pass
