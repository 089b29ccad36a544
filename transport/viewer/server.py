"""Web server of the viewer: viser on a checked address, for requests that are meant for it.

A page of another site can send requests to every port of this machine, and a name of its own may lead here (DNS
rebinding). So the server answers only if `Host` names it and `Origin`, which browsers send with a WebSocket, is the
same; and a live run, which a page can change, is shown only below a secret path.
"""

import asyncio
import hmac
import io
import logging
import re
import secrets
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, redirect_stdout
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
_INVALID_DATA = 1007  # close code of RFC 6455
# websockets reports every refused and broken connection with a traceback.
_SILENT = logging.getLogger("transport.viewer.websockets")
_SILENT.disabled = True
_INSTALLING = threading.Lock()
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


class Guard:
    """Check of the requests to one server.

    Attributes:
        path: Path below which the server answers, `/` and the token; empty without a token.
        serves: Whether a server uses it.
        shown: Newest frame that each page has shown, by the number of its connection.
    """

    def __init__(self, host: str, token: str) -> None:
        self._host = host.lower()
        self.path = f"/{token}" if token else ""
        self.serves = False
        self.shown: dict[int, int] = {}

    def receipt(self, page: int, frame: int) -> str:
        """Return the path that a page asks for once it shows a frame."""
        return f"{self.path}/shown/{page}/{frame}"

    def refusal(self, path: str, host: str, origin: str | None) -> str:
        """Return why a request is refused, by its path and headers; empty for one that is answered."""
        if not self._is_own(_name(host)):
            return "the host of the request is not that of the viewer; open the printed link"
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "the request comes from a page of another site"
        token = "/" + path.partition("?")[0].lstrip("/").partition("/")[0]
        if self.path and not hmac.compare_digest(token.encode(), self.path.encode()):
            return "an active run is shown only below the link that the command has printed"
        return ""

    def _is_own(self, name: str) -> bool:
        """Return whether a host name is one of the viewer's; of a server on all addresses every address is."""
        if name in _LOOPBACK or name == self._host:
            return True
        return self._host in _ANY and (_is_address(name) or name in (socket.gethostname(), socket.getfqdn()))

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Check the requests to servers that viser starts meanwhile: it has no parameter for that."""
        import websockets.asyncio.server as library

        serve: Any = library.serve

        def guarded(handler: Any, *arguments: Any, process_request: Any, **options: Any) -> Any:
            self.serves = True
            answer = self._checked(process_request)
            return serve(_reporting(handler), *arguments, process_request=answer, logger=_SILENT, **options)

        with _INSTALLING:
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
                page, frame = map(int, receipt.groups())
                if page in self.shown:
                    self.shown[page] = max(self.shown[page], frame)
                return connection.respond(204, "")
            response: Response | None = answer(connection, request)
            return response

        return checked


def _reporting(handler: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., Coroutine[Any, Any, None]]:
    """Return a handler of connections that reports a message viser cannot read in one line and closes its sender."""

    async def handle(connection: "ServerConnection") -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: report_malformed(context.get("exception")))
        try:
            await handler(connection)
        except Exception as error:  # noqa: BLE001 - viser raises what its decoding raises: any kind
            report_malformed(error)
            await connection.close(_INVALID_DATA, "malformed message")

    return handle


def report_malformed(error: object) -> None:
    """Report a message that no page of the viewer sends, in one line on standard error."""
    sys.stderr.write(f"viewer: refused a malformed message of a browser ({type(error).__name__})\n")


def _name(host: str) -> str:
    """Return the name in a header `Host`, without port and brackets; empty if it is malformed."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _check_address(host: str, port: int) -> None:
    """Raise ViewerError for an address that cannot be used: viser would wait for it forever."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            if getattr(error, "errno", None) not in _IN_USE:  # viser takes the next free one
                raise ViewerError(f"--host, --port: cannot listen on {host}:{port} ({error})") from error
