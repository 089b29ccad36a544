"""Changes of links in words, for the roster, the report, the figures and the viewer."""

from collections.abc import Mapping
from typing import Any

from protocol.scenario.keys import key_of
from protocol.scenario.link_sections import LinkSection
from protocol.scenario.links import LinkError, link_change
from protocol.wire.messages import LinkChange

# Settings of a link that make it perfect: the defaults.
PERFECT: Mapping[str, Any] = {key: field.default for key, field in LinkSection.model_fields.items()}


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
    if PERFECT.items() <= settings.items():
        return f"{links} cleared"
    return f"{links}: {', '.join(_words(key, value) for key, value in settings.items())}"


def _words(key: str, value: Any) -> str:
    """Return a key of a link and its new value in words."""
    template = key_of(LinkSection.model_fields[key]).words
    if key == "gilbert_elliott":
        if value is None or not value["enter"]:
            return "no burst loss"
        return f"burst loss, entered with {100.0 * value['enter']:g} % and left with {100.0 * value['leave']:g} %"
    if value is None:
        return f"no {key}"
    if template:
        return template.format(100.0 * value if "%" in template else value)
    return f"{key} {value}"
