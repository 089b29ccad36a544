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
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
from typing import Any

from transport.protocol.wire.errors_and_exit_codes import TransportError

# websockets reports every refused and broken connection with a traceback.
_SILENT = logging.getLogger("transport.viewer.websockets")
_SILENT.disabled = True
_CLOSED = "Queued a .* on a closed connection"  # by viser
# Title of viser's page. If a release of viser has another one, its pages keep it.
_TITLE = b"<title>Viser</title>"
_RECEIPT = re.compile(r"/shown/(\d{1,9})/(\d{1,9})")

# Time after which a notification in the corner of the page ends, s.
NOTIFICATION_S = 8.0


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
    # HTML widget of the page, with an invisible image whose address names the newest frame. The page
    # asks for the image once it shows that frame, which is the receipt.
    receipt: Any
    sent: int = 0  # newest frame
    # Time since when the page has not told that it shows this frame; None once it has.
    unshown_since_s: float | None = None
    unshown: int = 0  # frames sent since the last one that it has told to show
    lag_s: float = 0.0  # time from the last frame that it has shown to its receipt

    def send(self, frame: int, now_s: float) -> None:
        """Note that the page gets a frame."""
        self.sent = frame
        self.unshown_since_s = now_s
        self.unshown += 1

    def shows_newest(self, now_s: float) -> None:
        """Note that the page shows the newest frame."""
        if self.unshown_since_s is not None:
            self.lag_s = now_s - self.unshown_since_s
        self.unshown_since_s = None
        self.unshown = 0


class Receipts:
    """Pages by the number of their connection, and what they tell of the frames that they show.

    The viewer adds pages and sends their frames; requests note the receipts. Both run in the event
    loop of the server, one after the other.
    """

    def __init__(self) -> None:
        self.pages: dict[int, Page] = {}

    def take(self, path: str) -> bool:
        """Return whether a path below the secret one is that of a receipt, and note it.

        It counts if the page shows the newest frame that it has been sent.
        """
        receipt = _RECEIPT.fullmatch(path)
        if receipt is None:
            return False
        number, frame = map(int, receipt.groups())
        page = self.pages.get(number)
        if page is not None and frame == page.sent:
            page.shows_newest(time.monotonic())
        return True


class Guard:
    """Check of the requests to one server: all are below its path."""

    def __init__(self, title: str) -> None:
        self.path = f"/{secrets.token_urlsafe(24)}"
        self.serves = False  # whether a server uses it
        self.receipts = Receipts()
        self._title = f"<title>{escape(title)}</title>".encode()

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Check the requests to servers that viser starts meanwhile; it has no option for it.

        The patch of websockets is global while it lasts: no other server may be started.
        """
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
        path = request.path.partition("?")[0]
        first = path.removeprefix("/").partition("/")[0]
        if not hmac.compare_digest(f"/{first}".encode(), self.path.encode()):
            return connection.respond(403, "expected the link that the command has printed\n")

        # What is below the secret path is for receipts, or for viser.
        request.path = request.path.removeprefix(self.path) or "/"
        if self.receipts.take(request.path):
            return connection.respond(204, "")

        answer = process_request(connection, request)
        if answer is not None and request.path.partition("?")[0] in ("/", "/index.html"):
            self._set_title(answer)
        return answer

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
    _check_address(host, port)

    guard = Guard(title)
    # viser prints its address to stdout, which is for results.
    with guard.installed(), redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if not guard.serves:
        server.stop()
        raise ViewerError(
            f"the viewer cannot check connections with viser {viser.__version__}; install viser 1.1"
        )
    name = f"[{host}]" if ":" in host else host
    return server, guard, f"http://{name}:{server.get_port()}{guard.path}"


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget if a browser has changed it.

    Changes by this process call nothing.
    """
    return lambda event: None if event.client_id is None else act(event.target.value)


def _check_address(host: str, port: int) -> None:
    """Check that a server can listen on an address; viser retries for ever on one that cannot be used.

    A port that is in use is no problem: viser takes the next free one.
    Raises: ViewerError.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                return
            text = f"--host, --port: cannot listen on {host}:{port} ({error})"
            raise ViewerError(text) from error
