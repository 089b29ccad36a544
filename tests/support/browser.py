"""Headless browser for tests of the viewer, and connections that look like browsers to the viewer."""

import base64
import io
import json
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypeVar
from urllib.parse import urlparse, urlsplit

import msgpack
import numpy as np
import pytest
import zstandard
from matplotlib.image import imread
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.wait import WebDriverWait
from websockets import Subprotocol
from websockets.sync.client import ClientConnection, connect

from tests.support.commands import PATIENCE_S, wait_for
from transport.model.arrays import Array

_Result = TypeVar("_Result")

_CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
_DRIVER = shutil.which("chromedriver")
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # not available in a container
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=900,600",
    "--force-device-scale-factor=0.5",  # a quarter of the pixels: the processor draws them
)

needs_browser = pytest.mark.skipif(
    _CHROMIUM is None or _DRIVER is None,
    reason="no Chromium with its driver (Debian: apt-get install chromium chromium-driver)",
)

# Three.js warns that one of its own parts is deprecated. viser's page removes elements at once and takes
# updates at the end of a frame: one that comes before the removal, in the same frame, is an error to it.
_HARMLESS = ("THREE.Clock", "Tried to update non-existent component")

# First message of a page: without it, viser does not count the connection as a client.
_CAMERA: bytes = msgpack.packb(
    {
        "type": "ViewerCameraMessage",
        "wxyz": (1.0, 0.0, 0.0, 0.0),
        "position": (0.0, -10.0, 0.0),
        "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, -1.0),
        "fov": 0.75,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 600,
        "image_width": 900,
    }
)

# Calls back after the next drawing with its image and its geometry: the matrix of every node by
# name, and the points of the lines directly below it, all in the coordinates of three.js.
_NEXT_DRAWING = """
const done = arguments[arguments.length - 1], canvas = document.querySelector('canvas');
const key = Object.keys(canvas).find((name) => name.startsWith('__reactFiber'));
let fiber = canvas[key];
while (fiber && !fiber.memoizedProps?.value?.mutable?.current?.nodeRefFromName) fiber = fiber.return;
const viewer = fiber.memoizedProps.value.mutable.current;
viewer.scene.onAfterRender = (renderer) => {
  viewer.scene.onAfterRender = () => {};
  const nodes = {};
  for (const [name, node] of Object.entries(viewer.nodeRefFromName)) {
    if (!node) continue;
    const points = [];
    node.traverse((part) => {
      const start = part.geometry?.attributes?.instanceStart, end = part.geometry?.attributes?.instanceEnd;
      if (!part.isLineSegments2 || !start) return;
      for (let k = 0; k < start.count; ++k)
        for (const at of [start, end])
          points.push(part.localToWorld(part.position.clone().set(at.getX(k), at.getY(k), at.getZ(k))).toArray());
    });
    nodes[name] = {matrix: node.matrixWorld.toArray(), points};
  }
  const camera = viewer.camera;
  const sight = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).toArray();
  done({nodes, sight, image: renderer.domElement.toDataURL('image/png').split(',')[1]});
};
viewer.requestRender();
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """One drawing of a page.

    Attributes:
        image: The 3D view as PNG.
        sight: From page coordinates to those of the view, (4, 4): what is seen is within -1..1.
        poses: Matrix of every node by name, (4, 4), page coordinates.
        points: Ends of the line segments of every node and the nodes below it, (2 k, 3), page
            coordinates.
    """

    image: bytes
    sight: Array
    poses: dict[str, Array]
    points: dict[str, Array]

    def sees(self, name: str) -> bool:
        """Return whether the origin of a node is within the view."""
        x, y, z, w = self.sight @ self.poses[name][:, 3]
        return bool(w > 0.0 and max(abs(x), abs(y), abs(z)) <= w)

    def place(self, name: str, point: Array) -> tuple[float, float]:
        """Return the place in the view, -1..1 to the right and up, of a point in the frame of a node."""
        x, y, _, w = self.sight @ self.poses[name] @ np.append(point, 1.0)
        return float(x / w), float(y / w)


class Page(ClientConnection):
    """Connection that looks like a page; `first` are the first messages it got."""

    first: bytes

    def messages(self) -> bytes:
        """Return the next messages, MessagePack, without the arrays behind them."""
        return unpacked(self.recv(timeout=PATIENCE_S, decode=False))


def unpacked(frame: bytes) -> bytes:
    """Return the messages in a frame of viser, MessagePack, without the arrays behind them."""
    return zstandard.decompress(frame[16 : 16 + int.from_bytes(frame[8:16], "little")])


@contextmanager
def connected_pages(address: str, count: int) -> Iterator[list[Page]]:
    """Connect as pages do, without drawing; disconnect without notice afterwards."""
    connections: list[Page] = []
    parts = urlsplit(address)
    try:
        for _ in range(count):
            page = connect(
                address.replace("http", "ws", 1),
                sock=socket.create_connection((parts.hostname, parts.port)),
                subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
                max_size=None,
                create_connection=Page,
            )
            assert isinstance(page, Page)
            connections.append(page)
            page.send(_CAMERA)
            first = page.recv(timeout=PATIENCE_S)
            assert isinstance(first, bytes)
            page.first = first
        yield connections
    finally:
        for connection in connections:
            connection.socket.close()


class Browser:
    """One browser window."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def open(self, address: str) -> None:
        """Open the viewer and wait for its widgets."""
        self.leave()  # an open page would report the loss of its server
        self.console()
        self.driver.get(address)
        assert wait_for(lambda: self.text() is not None and bool(self.values()))

    def leave(self) -> None:
        """Close the page."""
        self.driver.get("about:blank")

    def settled(self, action: Callable[[], _Result]) -> _Result:
        """Return what an action on elements returns, once the page does not replace them meanwhile."""
        wait = WebDriverWait(
            self.driver, PATIENCE_S, ignored_exceptions=(StaleElementReferenceException,)
        )
        return wait.until(lambda _: (action(),))[0]

    def click(self, text: str, number: int = 0) -> None:
        """Click a button with this text, by its number among those with the same text."""

        def click() -> None:
            found = self.driver.find_elements("css selector", "button")
            button = [b for b in found if b.text == text][number]
            self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
            button.click()

        self.settled(click)

    def text(self) -> str | None:
        """Return the text of the page; None while it loads or has none."""
        return self.settled(lambda: self.driver.find_element("css selector", "body").text) or None

    def shows(self, text: str) -> bool:
        """Return whether the page has a text."""
        return text in (self.text() or "")

    def values(self) -> set[tuple[float, float]]:
        """Return largest and present value of each slider."""
        script = "return [...document.querySelectorAll('[role=slider]')].map((s) => [s.ariaValueMax, s.ariaValueNow])"
        return {
            (float(largest), float(value)) for largest, value in self.driver.execute_script(script)
        }

    def type(self, label: str, text: str) -> None:
        """Replace the text of a field, as fast as the browser takes it."""

        def type_() -> None:
            field = self.driver.find_element(
                "xpath", f"(//label[text()='{label}']/following::input)[1]"
            )
            field.send_keys(Keys.CONTROL, "a")
            field.send_keys(text)

        self.settled(type_)

    def press(self, largest: float, *keys: str) -> None:
        """Move the slider with this largest value by keys."""

        def press() -> None:
            handle = f"[role=slider][aria-valuemax='{largest:g}']"
            slider = self.driver.find_element("css selector", handle)
            self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
            slider.send_keys(*keys)

        self.settled(press)

    def plots(self) -> list[str]:
        """Return the image of each plot in the panel."""
        script = (
            "return [...document.querySelectorAll('.uplot canvas')].map((plot) => plot.toDataURL())"
        )
        found: list[str] = self.driver.execute_script(script)
        return found

    def pixels(self) -> Any:
        """Return the pixels of the 3D view, (height, width, 3), 0..1."""
        data = self.driver.find_element("css selector", "canvas").screenshot_as_png
        return np.asarray(imread(io.BytesIO(data), format="png"))[..., :3]

    def drawing(self) -> Drawing:
        """Return the next drawing of the 3D view: image and positions of the same moment."""
        self.driver.set_script_timeout(PATIENCE_S)
        result = self.driver.execute_async_script(_NEXT_DRAWING)
        nodes: dict[str, Any] = result["nodes"]
        return Drawing(
            image=base64.b64decode(result["image"]),
            sight=np.array(result["sight"]).reshape(4, 4).T,
            poses={name: np.array(node["matrix"]).reshape(4, 4).T for name, node in nodes.items()},
            points={name: np.array(node["points"]).reshape(-1, 3) for name, node in nodes.items()},
        )

    def console(self) -> list[str]:
        """Return errors and warnings of the console since the last call."""
        log: list[dict[str, Any]] = self.driver.get_log("browser")  # type: ignore[no-untyped-call]
        texts = [entry["message"] for entry in log if entry["level"] not in ("INFO", "DEBUG")]
        return [text for text in texts if not any(harmless in text for harmless in _HARMLESS)]

    def hosts(self) -> set[str]:
        """Return the hosts that the browser has sent requests to."""
        log: list[dict[str, Any]] = self.driver.get_log("performance")  # type: ignore[no-untyped-call]
        entries = [json.loads(entry["message"])["message"] for entry in log]
        urls = [
            e["params"]["request"]["url"]
            for e in entries
            if e["method"] == "Network.requestWillBeSent"
        ]
        return {str(urlparse(url).hostname) for url in urls if url.startswith("http")}


@contextmanager
def browser() -> Iterator[Browser]:
    """Start a browser and quit it afterwards."""
    options = Options()
    options.binary_location = str(_CHROMIUM)
    for option in _OPTIONS:
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(_DRIVER)))
    try:
        yield Browser(driver)
    finally:
        driver.quit()


END, RIGHT = Keys.END, Keys.ARROW_RIGHT
