"""Time of the shown instant: a slider over the recorded time with events on it, and their list."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from transport.protocol.scenario.links.link_changes import scripted_changes
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.scene.history import RunHistory, merged
from transport.viewer.playback import Playback
from transport.viewer.server import from_browser

# Buttons of events below the plots: those around the shown instant.
_BUTTONS = 8
# Digits of a time, s.
_DIGITS = 9
# Longest text on a button; its whole text is the hint.
_LONGEST_LABEL = 54


class TimelineEvent(NamedTuple):
    """An event of a run: its tick, and a sentence."""

    tick: int
    text: str


def events_of(history: RunHistory) -> list[TimelineEvent]:
    """Return what has happened so far, in order of time, changes of links by the scenario too."""
    period_s = history.setup.settings.sampling_period_s
    changes = scripted_changes(history.setup.scenario.links)
    scripted = [TimelineEvent(first_tick(time_s, period_s), text) for time_s, text in changes]
    recorded = [TimelineEvent(tick, text) for tick, text in list(history.events)]
    happened = [event for event in (*scripted, *recorded) if event.tick <= history.last]
    return [TimelineEvent(tick, text) for tick, text in merged(happened)]


def events_around(events: list[TimelineEvent], tick: int, count: int) -> list[TimelineEvent]:
    """Return at most `count` events, half of them after a tick if there are as many."""
    past = int(np.searchsorted([event.tick for event in events], tick, side="right"))
    first = max(0, min(past - count // 2, len(events) - count))
    return events[first : first + count]


class Timeline:
    """Time slider and list of events of a viewer; both move the playback."""

    def __init__(self, gui: Any, history: RunHistory, playback: Playback) -> None:
        self._gui = gui
        self._history = history
        self._playback = playback
        self._period_s = history.setup.settings.sampling_period_s
        self._events: list[TimelineEvent] = []
        self._shown: list[TimelineEvent] = []
        self._slider = self._add_slider(order=None)
        self._buttons: list[Any] = []
        self._none: Any = None

    def add_list(self) -> None:
        """Add the list of events to the folder that is open."""
        self._none = self._gui.add_markdown("none yet")
        for number in range(_BUTTONS):
            button = self._gui.add_button("", visible=False, color="gray")
            button.on_click(partial(self._go_to, number))
            self._buttons.append(button)

    def show(self, tick: int) -> None:
        """Show a tick, and the events around it."""
        events = events_of(self._history)
        if events != self._events:
            self._events = events
            self._replace_slider()

        first_s, last_s = self._ends_s()
        if (self._slider.min, self._slider.max) != (first_s, last_s):
            self._slider.min = first_s
            self._slider.max = last_s
        self._slider.value = tick * self._period_s
        self._show_list(tick)

    def _ends_s(self) -> tuple[float, float]:
        """Return the first and the last recorded time, s."""
        first = self._history.first
        last = max(self._history.last, first)
        return round(first * self._period_s, _DIGITS), round(last * self._period_s, _DIGITS)

    def _add_slider(self, order: float | None) -> Any:
        first_s, last_s = self._ends_s()
        marks = tuple(event.tick * self._period_s for event in self._events)
        slider = self._gui.add_slider(
            "time (s)",
            first_s,
            max(last_s, first_s + self._period_s),
            self._period_s,
            first_s,
            marks=marks or None,
            hint="marks are events: see their list",
            order=order,
        )
        slider.on_update(
            from_browser(lambda time_s: self._playback.seek(round(time_s / self._period_s)))
        )
        return slider

    def _replace_slider(self) -> None:
        """Replace the slider by one with marks at the present events, which viser cannot change."""
        order = self._slider.order
        self._slider.remove()
        self._slider = self._add_slider(order)

    def _show_list(self, tick: int) -> None:
        self._shown = events_around(self._events, tick, _BUTTONS)
        if self._none is not None:
            self._none.visible = not self._shown
        for number, button in enumerate(self._buttons):
            button.visible = number < len(self._shown)
            if not button.visible:
                continue
            event = self._shown[number]
            text = f"{event.tick * self._period_s:.2f} s: {event.text}"
            button.label = text if len(text) <= _LONGEST_LABEL else f"{text[:_LONGEST_LABEL]}..."
            button.hint = text
            button.color = "gray" if event.tick <= tick else "blue"

    def _go_to(self, number: int, _: object) -> None:
        if number < len(self._shown):
            self._playback.seek(self._shown[number].tick)
