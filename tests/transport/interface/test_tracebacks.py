"""Errors of the user's input have short tracebacks: the user's frames and the public function, no library of ours."""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import transport

INTERFACE = Path(transport.__file__).parent / "interface"
HOVER = [{"name": "hover", "duration_s": 0.1, "displacement_m": [0.0, 0.0, 0.0]}]


def scenario() -> Any:
    """Return a scenario; untyped, as a notebook uses it."""
    return transport.Scenario("resilient", phases=HOVER)


@pytest.fixture(scope="module")
def run() -> transport.Run:
    """Return a run of two ticks."""
    return transport.fly(scenario(), progress=False)


def changed(key: str, value: Any) -> None:
    """Change a key of a section."""
    setattr(scenario().links, key, value)


# Calls by the public function that refuses them, which is named up to the comma.
REFUSED: dict[str, Callable[[transport.Run, Path], Any]] = {
    "fly": lambda run, folder: transport.fly("papr"),
    "fly, setting": lambda run, folder: transport.fly("paper", {"links.loss": 2.0}),
    "fly, in memory": lambda run, folder: transport.fly("paper", {"clock.mode": "realtime", "clock.speed": 1.0}),
    "load": lambda run, folder: transport.load(folder),
    "sweep": lambda run, folder: transport.sweep("paper", {"loss": [0.1, 2.0]}, workers=1, progress=False),
    "__init__": lambda run, folder: transport.Scenario("paper", horizon=0),
    "__setattr__, section": lambda run, folder: changed("delay_s", -1.0),
    "__getitem__": lambda run, folder: scenario()["links.los"],
    "save": lambda run, folder: run.save(folder),
    "view": lambda run, folder: run.view("no address"),
    "unit": lambda run, folder: run.series.unit("cots"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_the_traceback_ends_at_the_public_function(case: str, run: transport.Run, tmp_path: Path) -> None:
    """Behind the user's call there is one frame, of the function that was called, and no second exception."""
    if case == "view":
        pytest.importorskip("viser")
    with pytest.raises(transport.TransportError) as caught:
        REFUSED[case](run, tmp_path)
    frames = traceback.extract_tb(caught.value.__traceback__)
    ours = [frame for frame in frames if not frame.filename.startswith(str(Path(__file__)))]
    assert [(frame.name, Path(frame.filename).parent) for frame in ours] == [(case.partition(",")[0], INTERFACE)]
    assert frames[-1] == ours[0]
    text = "".join(traceback.format_exception(caught.value))
    assert text.count("Traceback") == 1
    assert "pydantic" not in text
