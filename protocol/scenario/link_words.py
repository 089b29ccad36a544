"""Changes of links in words, for the roster, the report, the figures and the viewer."""

from collections.abc import Mapping
from typing import Any

from protocol.scenario.links import LinkError, link_change
from protocol.wire.messages import LinkChange

# Settings of a link that make it perfect.
PERFECT: Mapping[str, Any] = {
    "delay_s": 0.0,
    "jitter_s": 0.0,
    "distribution": "uniform",
    "loss": 0.0,
    "gilbert_elliott": {"enter": 0.0, "leave": 1.0},
    "duplicate": 0.0,
    "reorder": 0.0,
    "rate_hz": 1e9,
}

# Templates of the settings that are numbers; those in percent are shares.
_NUMBERS = {
    "delay_s": "delay {:g} s",
    "jitter_s": "jitter {:g} s",
    "reorder_s": "{:g} s more for reordered messages",
    "rate_hz": "at most {:g} messages per second",
}
_PERCENT = {"loss": "loss {:g} %", "duplicate": "duplication {:g} %", "reorder": "reordering {:g} %"}


def words_of(change: LinkChange) -> str:
    """Return the change in a message of the coordinator in words; its text as it is if it is no valid change."""
    try:
        settings = link_change(change.source, change.target, change.settings).settings()
    except LinkError:
        return f"links: {change.settings}"
    return change_in_words(change.source, change.target, settings)


def change_in_words(source: str, target: str, settings: Mapping[str, Any]) -> str:
    """Return a change of links in words, such as "links from agent1 to agent2: delay 0.2 s, loss 30 %".

    Args:
        source: Name of the sender, empty for any agent.
        target: Name of the receiver, empty for any agent.
        settings: Valid keys and values of a link; all of `PERFECT` are a cleared link.
    """
    ends = (f" from {source}" if source else "") + (f" to {target}" if target else "")
    links = f"links{ends or ' between agents'}"
    if all(key in settings and _words(key, settings[key]) == _words(key, value) for key, value in PERFECT.items()):
        return f"{links} cleared"
    return f"{links}: {', '.join(_words(key, value) for key, value in settings.items())}"


def _words(key: str, value: Any) -> str:
    """Return a key of a link and its new value in words."""
    if value is not None and key in _NUMBERS:
        return _NUMBERS[key].format(value)
    if key in _PERCENT:
        return _PERCENT[key].format(100.0 * value)
    if key == "gilbert_elliott":
        if value is None or not value["enter"]:
            return "no burst loss"
        return f"burst loss, entered with {100.0 * value['enter']:g} % and left with {100.0 * value['leave']:g} %"
    if value is None:
        return f"no {key}"
    return f"{key} {value}"
