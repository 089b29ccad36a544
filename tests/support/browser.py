"""A browser without a screen, driven as a person would: what it shows, what it complains of, whom it asks."""

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.keys import Keys

from benchmarks.watched import HEADLESS
from tests.support.commands import wait_for

_CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_DRIVER = shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(
    _CHROMIUM is None or _DRIVER is None,
    reason="no Chromium with its driver (Debian: apt-get install chromium chromium-driver)",
)

# Three.js says of one of its own parts that it will go.
_HARMLESS = ("THREE.Clock",)


class Browser:
    """One window of it."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def open(self, address: str) -> None:
        """Open the viewer and wait until it has its widgets."""
        self.leave()  # what was open does not miss its server
        self.complaints()
        self.driver.get(address)
        assert wait_for(lambda: self.label() is not None and bool(self.sliders()))

    def leave(self) -> None:
        """Close the page."""
        self.driver.get("about:blank")

    def click(self, text: str, number: int = 0) -> None:
        """Press a button, the one with this number of those that say the same."""
        buttons = [b for b in self.driver.find_elements("css selector", "button") if b.text == text]
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", buttons[number])
        buttons[number].click()

    def label(self) -> str | None:
        """Text of the panel."""
        return self.driver.find_element("css selector", "body").text or None

    def sliders(self) -> dict[float, Any]:
        """Handles of the sliders by their largest value."""
        found = self.driver.find_elements("css selector", "[role=slider]")
        return {float(slider.get_attribute("aria-valuemax") or "nan"): slider for slider in found}

    def press(self, largest: float, *keys: str) -> None:
        """Move the slider with this largest value by keys."""
        slider = self.sliders()[largest]
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
        slider.send_keys(*keys)

    def pixels(self, folder: Path | None = None, name: str = "") -> Any:
        """What the 3D part shows, (height, width, 3); kept as a picture for people if there is a folder."""
        from matplotlib.image import imread

        data = self.driver.find_element("css selector", "canvas").screenshot_as_png
        if folder is not None:
            (folder / f"{name}.png").write_bytes(self.driver.get_screenshot_as_png())
        return np.asarray(imread(io.BytesIO(data), format="png"))[..., :3]

    def put(self, element: str) -> None:
        """Make an element, as HTML, all there is of the page."""
        self.driver.execute_script("document.body.innerHTML = arguments[0]", element)

    def drawn(self) -> int:
        """How many pictures the page has been given since this was asked first, while it wants one after another."""
        count = "if (window.drawn === undefined) { window.drawn = 0; const draw = () => { ++window.drawn; "
        loop = "requestAnimationFrame(draw); }; requestAnimationFrame(draw); } return window.drawn;"
        return int(self.driver.execute_script(count + loop))

    def complaints(self) -> list[str]:
        """Errors and warnings of its console."""
        log: list[dict[str, Any]] = self.driver.get_log("browser")  # type: ignore[no-untyped-call]
        said = [entry["message"] for entry in log if entry["level"] not in ("INFO", "DEBUG")]
        return [text for text in said if not any(harmless in text for harmless in _HARMLESS)]

    def hosts(self) -> set[str]:
        """Whom it has asked for anything."""
        log: list[dict[str, Any]] = self.driver.get_log("performance")  # type: ignore[no-untyped-call]
        events = [json.loads(entry["message"])["message"] for entry in log]
        asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        return {str(urlparse(url).hostname) for url in asked if url.startswith("http")}


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser that is gone afterwards."""
    options = Options()
    options.binary_location = str(_CHROMIUM)
    for option in HEADLESS:
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(_DRIVER)))
    try:
        yield Browser(driver)
    finally:
        driver.quit()


END, RIGHT = Keys.END, Keys.ARROW_RIGHT
