"""Changes of links in words: every key of a link has words, and "clear all links" is one short sentence."""

import json
from typing import Any

import pytest

from protocol.scenario.link_sections import LinkSection
from protocol.scenario.links import PERFECT, change_in_words, link_change

# A value of each key of a link, and its words.
EXAMPLES: dict[str, tuple[Any, str]] = {
    "delay_s": (0.2, "delay 0.2 s"),
    "jitter_s": (0.05, "jitter 0.05 s"),
    "distribution": ("normal", "distribution normal"),
    "samples": ("delays.csv", "samples delays.csv"),
    "loss": (0.3, "loss 30 %"),
    "gilbert_elliott": ({"enter": 0.1, "leave": 0.5}, "burst loss, entered with 10 % and left with 50 %"),
    "duplicate": (0.01, "duplication 1 %"),
    "reorder": (0.1, "reordering 10 %"),
    "reorder_s": (0.2, "0.2 s more for reordered messages"),
    "rate_hz": (10.0, "at most 10 messages per second"),
}


def test_every_key_has_words() -> None:
    """The words of a change name each given key with its value and unit."""
    assert EXAMPLES.keys() == LinkSection.model_fields.keys()
    for key, (value, words) in EXAMPLES.items():
        assert change_in_words("", "", {key: value}) == f"links between agents: {words}"


def test_the_default_of_every_key_has_words() -> None:
    """A change back to the default of a key is a sentence without None, braces or quotes."""
    for key, field in LinkSection.model_fields.items():
        words = change_in_words("", "", {key: field.default})
        assert not {"{", "'", '"'} & set(words)
        assert "None" not in words


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        (("agent1", "agent2"), "links from agent1 to agent2: loss 100 %"),
        (("plant", ""), "links from plant: loss 100 %"),
        (("", "agent3"), "links to agent3: loss 100 %"),
    ],
)
def test_both_ends_are_named(ends: tuple[str, str], words: str) -> None:
    """The sender and the receiver are named if they are given."""
    assert change_in_words(*ends, {"loss": 1.0}) == words


def test_cleared_links_are_short() -> None:
    """All keys of a cleared link are one word, also with the defaults that the schema adds; one key less is a list."""
    assert change_in_words("", "", PERFECT) == "links between agents cleared"
    assert change_in_words("plant", "", PERFECT) == "links from plant cleared"
    section = link_change("", "", json.dumps(dict(PERFECT)))
    assert section.perfect
    assert change_in_words("", "", section.settings()) == "links between agents cleared"
    assert "delay 0 s, jitter 0 s" in change_in_words("", "", {**PERFECT, "loss": 0.1})
