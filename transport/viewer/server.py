"""Web server of the viewer: viser on a checked address, for requests that are meant for it.

A page of another site can send requests to every port of this machine, and a name of its own may lead here (DNS
rebinding). So the server answers only if `Host` names it and `Origin`, which browsers send with a WebSocket, is the
same; and a live run, which a page can change, is shown only below a secret path.
"""

import hmac
import io
import logging
import re
import secrets
import socket
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from protocol.wire.errors import TransportError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

# errno of a port in use on Linux, macOS.
_IN_USE = (98, 48)
_LOOPBACK = frozenset(("localhost", "127.0.0.1", "::1"))
# Addresses that stand for all addresses of this machine.
_ANY = frozenset(("", "0.0.0.0", "::"))  # noqa: S104 - compared, not bound
# websockets reports every refused and broken connection with a traceback.
_SILENT = logging.getLogger("transport.viewer.websockets")
_SILENT.disabled = True
_CLOSED = "Queued a .* on a closed connection"  # by viser
_RECEIPT = re.compile(r"/shown/(\d{1,9})/(\d{1,9})")


class ViewerError(TransportError, RuntimeError):
    """The viewer cannot start; the text says why and what to do."""


def require_viser() -> None:
    """Raise ViewerError if viser is not installed."""
    if find_spec("viser") is None:
        raise ViewerError("viser is not installed: pip install 'payload-transport[view]'")


def start_server(host: str, port: int, *, secret: bool) -> tuple["viser.ViserServer", "Guard", str]:
    """Start a viser server on the first free port from `port` on, or on any for 0.

    Returns: The server, its guard, and its URL, with `secret` with a path without which every request is refused.
    Raises: ViewerError: viser is not installed, the address is not usable, or no port is free.
    """
    require_viser()
    import viser

    # A page may go, or the viewer end, at any moment; then nobody needs what is sent to it.
    warnings.filterwarnings("ignore", _CLOSED, UserWarning)
    _check_address(host, port)
    guard = Guard(host, secrets.token_urlsafe(24) if secret else "")
    with guard.installed(), redirect_stdout(io.StringIO()):  # viser prints its address to stdout, which is for results
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if not guard.serves:
        server.stop()
        raise ViewerError(f"the viewer cannot check connections with viser {viser.__version__}; install viser 1.1")
    name = f"[{host}]" if ":" in host else host
    return server, guard, f"http://{name}:{server.get_port()}{guard.path}"


@dataclass
class Page:
    """One page: the newest frames sent and shown, when it showed one, and the widget that asks it to tell."""

    sent: int
    shown: int
    progress_s: float
    receipt: Any


class Guard:
    """Check of the requests to one server.

    Attributes:
        path: Path below which the server answers, `/` and the token; empty without a token.
        serves: Whether a server uses it.
        pages: Pages by the number of their connection.
    """

    def __init__(self, host: str, token: str) -> None:
        self._host = host.lower()
        self.path = f"/{token}" if token else ""
        self.serves = False
        self.pages: dict[int, Page] = {}

    def refusal(self, path: str, host: str, origin: str | None) -> str:
        """Return why a request is refused, by its path and headers; empty for one that is answered."""
        name = ""
        with suppress(ValueError):  # malformed
            name = urlsplit(f"//{host}").hostname or ""
        if name not in _LOOPBACK and name != self._host and not (self._host in _ANY and _is_here(name)):
            return "the host of the request is not that of the viewer; open the printed link"
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "the request comes from a page of another site"
        token = "/" + path.partition("?")[0].lstrip("/").partition("/")[0]
        if self.path and not hmac.compare_digest(token.encode(), self.path.encode()):
            return "an active run is shown only below the link that the command has printed"
        return ""

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Check the requests to servers that viser starts meanwhile: it has no parameter for that."""
        import websockets.asyncio.server as library

        serve: Any = library.serve

        def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
            self.serves = True
            return serve(*arguments, process_request=self._checked(process_request), logger=_SILENT, **options)

        library.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            library.serve = serve  # type: ignore[misc]

    def _checked(self, answer: Callable[..., Any]) -> Callable[..., Any]:
        def checked(connection: "ServerConnection", request: "Request") -> "Response | None":
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            if len(hosts) != 1 or len(origins) > 1:
                return connection.respond(403, "expected one header Host and at most one Origin\n")
            if why := self.refusal(request.path, hosts[0], origins[0] if origins else None):
                return connection.respond(403, f"{why}\n")
            request.path = request.path.removeprefix(self.path) or "/"
            if receipt := _RECEIPT.fullmatch(request.path):
                number, frame = map(int, receipt.groups())
                if (page := self.pages.get(number)) is not None:
                    page.shown, page.progress_s = max(page.shown, frame), time.monotonic()
                return connection.respond(204, "")
            response: Response | None = answer(connection, request)
            return response

        return checked


def _is_here(name: str) -> bool:
    """Return whether a host name is an address, or a name of this machine."""
    with suppress(ValueError):
        return bool(ip_address(name))
    return name in (socket.gethostname(), socket.getfqdn())


def _check_address(host: str, port: int) -> None:
    """Raise ViewerError for an address that cannot be used: viser would wait for it forever."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            if getattr(error, "errno", None) not in _IN_USE:  # viser takes the next free one
                raise ViewerError(f"--host, --port: cannot listen on {host}:{port} ({error})") from error
