"""Completion of `--set KEY=VALUE` by the shell: keys of a scenario, and the values they may have."""

import os
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin

import typer

# Stands in a key for the number of an entry of a list.
_NUMBER = "#"
# Environment of a completion: its kind, the words of the line, and the place of the one completed.
_KIND = "_TRANSPORT_COMPLETE"
_BASH = "complete_bash"
_WORDS = "COMP_WORDS"
_PLACE = "COMP_CWORD"
# The key, where bash asks for its value alone.
_KEY = "_TRANSPORT_COMPLETE_KEY"


def rejoin_settings() -> None:
    """Join the words of options and settings in a completion by bash, which splits them at each sign =.

    `--set clock.mode=real` arrives as the words `--set`, `clock.mode`, `=` and `real`, of which bash
    replaces `real` alone. It is completed as the value of the key in the environment, `_KEY`. The
    group of commands calls this before it completes.
    """
    if os.environ.get(_KIND) != _BASH:
        return
    try:
        words = shlex.split(os.environ[_WORDS])
    except ValueError:  # an open quotation mark
        return
    place = int(os.environ[_PLACE])
    # The cursor is at the sign or right behind it: bash replaces the value alone.
    is_split = "=" in words[place - 1 : place + 1]
    joined, place = _rejoined(words, place)
    option = "" if joined[place - 1] == "--set" else "--set="
    if is_split and joined[place].startswith(option):
        key, sign, value = joined[place].removeprefix(option).partition("=")
        if sign:
            os.environ[_KEY] = key
            joined[place] = option + value
    os.environ |= {_WORDS: shlex.join(joined), _PLACE: str(place)}


def _rejoined(words: Sequence[str], place: int) -> tuple[list[str], int]:
    """Return words with those around a sign = in one, and the place of the completed one in them."""
    if place == len(words):
        words = [*words, ""]  # a new word is completed

    joined = [words[0]]
    joined_place = 0
    for index, (before, word) in enumerate(pairwise(words), start=1):
        is_value = before == "=" and index != place + 1  # behind the cursor another word begins
        if word == "=" or is_value:
            joined[-1] += word
        else:
            joined.append(word)
        if index == place:
            joined_place = len(joined) - 1
    return joined, joined_place


def complete_setting(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the keys of a scenario that begin like an incomplete word.

    If one key remains, its settings KEY=VALUE are returned: with every choice, or else with no value
    and with that of the scenario. Shells add a space to a single word, which a key must not have.
    """
    key_before = os.environ.pop(_KEY, None)
    if key_before is not None:
        settings = _settings(f"{key_before}={incomplete}", ctx)
        return [setting.removeprefix(f"{key_before}=") for setting in settings]
    return _settings(incomplete, ctx)


def _settings(incomplete: str, ctx: typer.Context) -> list[str]:
    """Return the keys, or the settings of one key, that begin like an incomplete setting."""
    typed_key, has_value, _ = incomplete.partition("=")
    keys = dict(_keys(typed_key.split(".")))
    found = [key for key in keys if key.startswith(typed_key)]
    if has_value:
        found = [key for key in found if key == typed_key]
    if len(found) != 1:
        return found

    (key,) = found
    words = [f"{key}={value}" for value in _values(key, keys[key].annotation, ctx)]
    return [word for word in words if word.startswith(incomplete)]


def _keys(typed: list[str]) -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys of all values, with their fields.

    A list has the number that is typed there, 1 without any.
    """
    from transport.protocol.scenario.sections.scenario_keys import section_in
    from transport.protocol.scenario.sections.schema import Scenario

    for parts, field in _below(Scenario, ()):
        if section_in(field.annotation) is None:
            yield ".".join(_numbered(parts, typed)), field


def _below(section: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every key and section below a section by the parts of its dotted key."""
    from transport.protocol.scenario.sections.scenario_keys import names_of, section_in

    for key, name in names_of(section).items():
        field = section.model_fields[name]
        parts = (*path, key)
        yield parts, field

        inner = section_in(field.annotation)
        if inner is not None:
            is_list = get_origin(field.annotation) in {list, tuple}
            yield from _below(inner, (*parts, _NUMBER) if is_list else parts)


def _numbered(parts: tuple[str, ...], typed: list[str]) -> Iterator[str]:
    """Yield the parts of a key, with the typed numbers of entries in their places."""
    for place, part in enumerate(parts):
        word = typed[place] if place < len(typed) else ""
        number = word if word.isdecimal() and int(word) > 0 else "1"
        yield number if part == _NUMBER else part


def _values(key: str, annotation: Any, ctx: typer.Context) -> list[str]:
    """Return the values that a key may have; of a number or a text none and the present one."""
    choices = _choices(annotation)
    if choices:
        return choices
    return ["", *_present(key, ctx)]


def _choices(annotation: Any) -> list[str]:
    """Return the values of a choice, also of one that may be left out; empty for other kinds."""
    if annotation is bool:
        return ["true", "false"]
    if get_origin(annotation) is Literal:
        return [str(value) for value in get_args(annotation)]
    return [choice for inner in get_args(annotation) for choice in _choices(inner)]


def _present(key: str, ctx: typer.Context) -> Iterator[str]:
    """Yield the value that a key has in the scenario of the command line; nothing without one."""
    from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
    from transport.protocol.scenario.sections.scenario_errors import ScenarioError

    # Before `--set` has its value, click leaves the words of the command unassigned.
    unassigned = [str(word) for word in ctx.args]
    name = unassigned[0] if unassigned else ctx.params.get("scenario") or "paper"
    value: Any = None
    with suppress(ScenarioError, LookupError):
        value = read_scenario(find_scenario(str(name)), allow_large=True).tree()
        for part in key.split("."):
            value = value[int(part) - 1] if part.isdecimal() else value[part]
    if isinstance(value, int | float | str):
        yield str(value)
