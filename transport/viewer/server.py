"""Web server of the viewer: viser on a checked address, below a secret path.

A page of another site can send requests to every port of this machine, and a name of its own may
lead here (DNS rebinding). So the server answers only below a path that no other page knows.
"""

import errno
import gzip
import hmac
import io
import logging
import re
import secrets
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from typing import Any

from transport.protocol.wire.errors import TransportError

# websockets reports every refused and broken connection with a traceback.
_SILENT = logging.getLogger("transport.viewer.websockets")
_SILENT.disabled = True
_CLOSED = "Queued a .* on a closed connection"  # by viser
_TITLE = b"<title>Viser</title>"
_RECEIPT = re.compile(r"/shown/(\d{1,9})/(\d{1,9})")


class ViewerError(TransportError, RuntimeError):
    """The viewer cannot start; the text says why and what to do."""


def require_viser() -> None:
    """Raise ViewerError if viser is not installed."""
    if find_spec("viser") is None:
        raise ViewerError("viser is not installed: pip install 'payload-transport[view]'")


@dataclass
class Page:
    """One page of a browser."""

    client: Any  # its connection
    receipt: Any  # widget that asks the page to tell which frame it shows
    sent: int = 0  # newest frame
    since_s: float | None = None  # time since when the page has not told that it shows this frame


class Guard:
    """Check of the requests to one server.

    All are below its path; pages, by connection, tell the frames they show.
    """

    def __init__(self, title: str) -> None:
        self.path = f"/{secrets.token_urlsafe(24)}"
        self.serves = False  # whether a server uses it
        self.pages: dict[int, Page] = {}
        self._title = f"<title>{escape(title)}</title>".encode()

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Check the requests to servers that viser starts meanwhile; it has no option for it."""
        import websockets.asyncio.server as library

        serve: Any = library.serve

        def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
            self.serves = True

            def checked(connection: Any, request: Any) -> Any:
                return self._answer(connection, request, process_request)

            return serve(*arguments, process_request=checked, logger=_SILENT, **options)

        library.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            library.serve = serve  # type: ignore[misc]

    def _answer(self, connection: Any, request: Any, process_request: Any) -> Any:
        """Return the answer to a request: a refusal, a receipt, or that of viser."""
        token = "/" + request.path.partition("?")[0].lstrip("/").partition("/")[0]
        if not hmac.compare_digest(token.encode(), self.path.encode()):
            return connection.respond(403, "expected the link that the command has printed\n")

        request.path = request.path.removeprefix(self.path) or "/"
        receipt = _RECEIPT.fullmatch(request.path)
        if receipt:
            self._note_shown(*map(int, receipt.groups()))
            return connection.respond(204, "")

        answer = process_request(connection, request)
        if answer is not None and request.path.partition("?")[0] in ("/", "/index.html"):
            self._set_title(answer)
        return answer

    def _note_shown(self, number: int, frame: int) -> None:
        """Note that a page shows a frame, if it is the newest that it has been sent."""
        page = self.pages.get(number)
        if page is not None and frame == page.sent:
            page.since_s = None

    def _set_title(self, answer: Any) -> None:
        """Give the page the title of the run; viser has one name for all its pages."""
        is_packed = answer.headers.get("Content-Encoding") == "gzip"
        body = gzip.decompress(answer.body) if is_packed else answer.body
        body = body.replace(_TITLE, self._title, 1)
        answer.body = gzip.compress(body, compresslevel=1) if is_packed else body
        del answer.headers["Content-Length"]
        answer.headers["Content-Length"] = str(len(answer.body))


def start_server(host: str, port: int, title: str) -> tuple[Any, Guard, str]:
    """Start a viser server on the first free port from `port` on, or on any for 0.

    Return it, its guard and its URL. The title is that of its pages.

    Raises: ViewerError: viser is not installed, the address is not usable, or no port is free.
    """
    require_viser()
    import viser

    # A page may go, or the viewer end, at any moment; what is sent to it then is not needed.
    warnings.filterwarnings("ignore", _CLOSED, UserWarning)
    with socket.socket(
        socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM
    ) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))  # viser would wait for an address that cannot be used forever
        except (OSError, OverflowError) as error:
            if getattr(error, "errno", None) != errno.EADDRINUSE:  # viser takes the next free one
                raise ViewerError(
                    f"--host, --port: cannot listen on {host}:{port} ({error})"
                ) from error
    guard = Guard(title)
    with (
        guard.installed(),
        redirect_stdout(io.StringIO()),
    ):  # viser prints its address to stdout, which is for results
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if not guard.serves:
        server.stop()
        raise ViewerError(
            f"the viewer cannot check connections with viser {viser.__version__}; install viser 1.1"
        )
    name = f"[{host}]" if ":" in host else host
    return server, guard, f"http://{name}:{server.get_port()}{guard.path}"
