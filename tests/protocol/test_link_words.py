"""Changes of links in words: every key of a link has words, and "clear all links" is one short sentence."""

from typing import Any

from protocol.scenario.link_sections import LinkSection
from protocol.scenario.links import change_in_words

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
