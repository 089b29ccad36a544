"""Web server of the viewer: viser on a checked address."""

import io
import socket
from contextlib import redirect_stdout
from importlib.util import find_spec
from typing import TYPE_CHECKING

from protocol.wire.errors import TransportError

if TYPE_CHECKING:
    import viser

# Number of ports to try, from the requested one.
_PORTS = 100
# errno of a port in use on Linux, macOS.
_IN_USE = (98, 48)


class ViewerError(TransportError, RuntimeError):
    """The viewer cannot start; the text says why and what to do."""


def require_viser() -> None:
    """Raise ViewerError if viser is not installed."""
    if find_spec("viser") is None:
        raise ViewerError("viser is not installed: pip install 'payload-transport[view]'")


def start_server(host: str, port: int) -> "viser.ViserServer":
    """Start a viser server on the first free port from `port` on, or on any for 0.

    Raises: ViewerError: viser is not installed, the address is not usable, or no port is free.
    """
    require_viser()
    import viser

    _check_port(host, port)
    with redirect_stdout(io.StringIO()):  # viser prints its address to stdout, which is for results
        return viser.ViserServer(host=host, port=port, verbose=False)


def told_port(requested: int, got: int) -> str:
    """Return a sentence that the server listens on another port than the requested one; empty if it does not."""
    return "" if requested in (0, got) else f"port {requested} is taken; the viewer listens on port {got}"


def _check_port(host: str, port: int) -> None:
    """Raise ViewerError for an address that cannot be used: viser would wait for it forever."""
    for candidate in range(port, port + _PORTS) if port else (0,):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
            except (OSError, OverflowError) as error:
                if getattr(error, "errno", None) in _IN_USE:
                    continue
                raise ViewerError(f"--host, --port: cannot listen on {host}:{candidate} ({error})") from error
        return
    raise ViewerError(f"--port: expected a free port from {port} on, got none in {_PORTS}")
