"""Progress of a simulation in memory: a bar on a terminal, a line in a notebook, lines of text elsewhere."""

import html
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from protocol.scenario.setup import Setup
from protocol.scenario.targets import with_targets
from protocol.wire.messages import Message, PlantState, Target
from transport.flight.progress import RunProgress

# Shortest time between two updates, wall time, s.
_EVERY_S = 0.1


def console(*, shown: bool) -> Console:
    """Return the console for progress: standard error; in a notebook lines of text, neither a widget nor a terminal."""
    if _in_notebook():
        return Console(quiet=not shown, force_jupyter=False, force_terminal=False)
    return Console(stderr=True, quiet=not shown)


@contextmanager
def run_progress(setup: Setup, *, shown: bool) -> Iterator[Callable[[Message], None]]:
    """Show the progress of a run; yield the function that takes each of its messages."""
    if not shown:
        yield lambda _: None
    elif _in_notebook():
        yield from _in_cell(setup)
    else:
        with RunProgress(setup, console(shown=True), waiting="in memory") as bar:
            show = _throttled(bar.show)

            def take(message: Message) -> None:
                if isinstance(message, Target):
                    bar.setup = with_targets(bar.setup, [message])
                show(message)

            yield take


def _in_cell(setup: Setup) -> Iterator[Callable[[Message], None]]:
    """Show the progress in the output of a notebook's cell, without widgets, and the duration at the end."""
    from IPython.display import HTML, display  # in every notebook

    handle: Any = display(HTML("<pre>starting</pre>"), display_id=True)
    duration_s, began_s = setup.ticks * setup.settings.sampling_period_s, time.monotonic()
    name = html.escape(setup.scenario.name)

    def show(plant_state: PlantState, _: float) -> None:
        reached_s = plant_state.tick * setup.settings.sampling_period_s
        bar = f'<progress value="{reached_s / duration_s:.3f}"></progress>'
        handle.update(HTML(f"{bar} {name}: {reached_s:.1f} of {duration_s:.1f} s"))

    try:
        yield _throttled(show)
    finally:
        handle.update(HTML(f"<pre>{name}: {time.monotonic() - began_s:.1f} s of wall time</pre>"))


def _throttled(show: Callable[[PlantState, float], None]) -> Callable[[Message], None]:
    """Return a function of messages that shows a plant state now and then."""
    began_s = next_s = time.monotonic()

    def take(message: Message) -> None:
        nonlocal next_s
        if isinstance(message, PlantState) and time.monotonic() >= next_s:
            next_s = time.monotonic() + _EVERY_S
            show(message, began_s)

    return take


def _in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython: Any = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")
