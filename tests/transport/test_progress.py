"""The progress of a run on the terminal: bar and time are shown at each width, the rest where it fits."""

import io
import re
import time

import pytest
from rich.console import Console

from tests.support import runs
from tests.support.runs import setup
from transport.flight.progress import RunProgress

RUN = setup()
PARTS = {60: "of 25.0 s", 80: "x real time", 100: "cost", 120: "attitude"}


@pytest.mark.parametrize("width", PARTS)
def test_the_bar_is_seen_at_each_width(width: int) -> None:
    """No line is longer than the terminal is wide, as the bar would vanish."""
    output = io.StringIO()
    with RunProgress(RUN, Console(file=output, force_terminal=True, width=width)) as progress:
        progress.show(runs.plant_state(RUN, 300), time.monotonic() - 3.0)
    shown = output.getvalue().rpartition("-:--:--")[0].rpartition("-:--:--")[2] + "-:--:--"
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\s*\r", "", shown)
    assert "━" in shown
    assert all((part in shown) == (least <= width) for least, part in PARTS.items())
    assert len(shown) <= width
