"""Errors of scenarios: one line with source, field, expected and got."""

import difflib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from transport.protocol.scenario.sections.scenario_keys import (
    milliseconds,
    names_of,
    out_of_range,
    section_in,
    short_names,
    unit_of,
)
from transport.protocol.scenario.sections.sources_of_values import Origin, source_of
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_SCENARIO,
    MessageError,
    TransportError,
)

S = TypeVar("S", bound=BaseModel)

# Keys whose name has changed, by their old one.
RENAMED = {"samples": "samples_s"}

_PERCENT = 100.0  # of the whole
# Least value given for a share that was probably meant in per cent.
_LEAST_PERCENT = 2.0
# Keys of numbers up to 1 that are not given in per cent.
_NO_SHARES = ("relaxation",)
_LONGEST_SHOWN = 80  # characters of a value that an error repeats
# Words for kinds of pydantic's problems, where its own are those of the library.
_EXPECTED = {
    "tuple_type": "expected a list",
    "model_type": "expected a section with keys",
    "string_type": "expected text",
    "too_short": "expected a list of at least {min_length}",
    "too_long": "expected a list of at most {max_length}",
}
# Kinds for a value that is no number.
_NO_NUMBER = ("float_type", "float_parsing")
_SIMILAR = 0.5  # similarity from which on a known name is offered for a mistyped one


class ScenarioError(TransportError, ValueError):
    """An invalid scenario: `source: field: expected ..., got ...`.

    The source is a file or an option, the field a dotted key with list entries from 1.
    """

    exit_code = EXIT_SCENARIO

    def __init__(self, source: str, field: str, problem: str) -> None:
        text = ": ".join(part for part in (source, field, problem) if part)
        super().__init__(" ".join(text.splitlines()))
        self.source = source
        self.field = field
        self.problem = problem

    def traced(self, origins: Sequence[Origin]) -> "ScenarioError":
        """Return the same error with the source that gave the field, of a merged scenario."""
        return type(self)(source_of(self.field, self.source, origins), self.field, self.problem)

    def blaming(self, settings: Sequence[str]) -> "ScenarioError":
        """Return the same error with settings as source if they gave the field or part of it."""
        given = [setting for setting in settings if _overlap(dotted_key(setting), self.field)]
        if not given:
            return self

        is_named = [dotted_key(setting) for setting in given] == [self.field]
        source = " ".join(option(setting) for setting in given)
        return type(self)(source, "" if is_named else self.field, self.problem)


class HoverError(ScenarioError):
    """A limit that hover exceeds, as masses and limits do not fit."""

    def blaming(self, settings: Sequence[str]) -> "ScenarioError":
        """Return the same error with the settings of the limit, else with those of the bodies."""
        blamed = super().blaming(settings)
        of_bodies = [setting for setting in settings if dotted_key(setting).startswith("system.")]
        if blamed is not self or not of_bodies:
            return blamed
        given = " ".join(option(setting) for setting in of_bodies)
        return HoverError(f"{self.source} with {given}", self.field, self.problem)


class RequestError(TransportError, MessageError):
    """A change of links or a target that is refused; the text has expected and got."""

    def __init__(self, text: str) -> None:
        super().__init__("out_of_range", text)


class PythonSetting(str):
    """A setting given in Python: it has its value, and errors name no command-line option."""

    value: Any


def dotted_key(setting: str) -> str:
    """Return the dotted key of a setting "key=value"."""
    return setting.partition("=")[0].strip()


def option(setting: str) -> str:
    """Return a setting as it was given, on the command line or in Python, shortened if long."""
    text = _short(setting) or repr(setting)
    return text if isinstance(setting, PythonSetting) else f"--set {text}"


def hint(name: str, known: Collection[str]) -> str:
    """Return the new name of a renamed key, the name that a mistyped one may stand for, or all."""
    section, _, key = name.rpartition(".")
    renamed = f"{section}.{RENAMED.get(key, key)}".lstrip(".")
    if renamed in known and renamed != name:
        return f"it is now {renamed!r}"

    similar = difflib.get_close_matches(name, known, n=1, cutoff=_SIMILAR)
    if similar:
        return f"did you mean {similar[0]!r}?"
    return f"known: {', '.join(known) or 'none'}"


def validated(section: type[S], tree: Any, source: str = "", folder: Path | None = None) -> S:
    """Return a section made of plain data, with files relative to a folder.

    Raises: ScenarioError: with the first problem.
    """
    try:
        made = section.model_validate(tree, context=folder)
    except ValidationError as error:
        # An unknown key first: a mistyped one is also missing.
        problem = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
        keys, innermost = _keys_of(problem, section)
        text = _problem_text(problem, innermost)
        raise ScenarioError(source, ".".join(keys), text) from error

    for field, text in out_of_range(made):
        raise ScenarioError(source, field, text)
    return made


def requested(section: type[S], tree: Any) -> S:
    """Return the section of a request.

    Raises: RequestError: it is not valid, whatever the run.
    """
    try:
        return validated(section, tree)
    except ScenarioError as error:
        raise RequestError(str(error)) from error


def _overlap(key: str, field: str) -> bool:
    """Return whether a key is a field, or one of them is within the other."""
    return f"{field}.".startswith(f"{key}.") or f"{key}.".startswith(f"{field}.")


def _keys_of(
    problem: Mapping[str, Any], section: type[BaseModel]
) -> tuple[list[str], type[BaseModel]]:
    """Return the keys that lead to one of pydantic's problems, and the innermost section."""
    place = problem["loc"]
    keys: list[str] = []
    for part in place:
        names = names_of(section)
        is_unknown_key = problem["type"] == "extra_forbidden" and part is place[-1]

        if part in names:
            section = section_in(section.model_fields[names[part]].annotation) or section

        if isinstance(part, int):
            keys.append(str(part + 1))
        elif part in names or is_unknown_key:
            keys.append(part)  # the branch of a union, which pydantic also names, is no key
    return keys, section


def _problem_text(problem: Mapping[str, Any], section: type[BaseModel]) -> str:
    """Return one of pydantic's problems within a section in words."""
    kind = problem["type"]
    if kind == "extra_forbidden":
        name = str(problem["loc"][-1])
        full = short_names(section).get(name)
        if full is not None and len(problem["loc"]) == 1:  # a short name of Python
            return f"unknown key; did you mean {full!r}?"
        return f"unknown key; {hint(name, names_of(section))}"
    if kind == "missing":
        return "expected a value, got nothing"
    if kind == "value_error":  # of a validator, whose text says all
        return str(problem["ctx"]["error"])

    value = problem["input"]
    if kind == "less_than_equal" and isinstance(value, int | float):
        largest = problem["ctx"]["le"]
        asked = milliseconds(str(problem["loc"][-1]), value, largest)
        if asked:
            return asked
        is_share = largest == 1.0 and not set(_NO_SHARES) & set(problem["loc"])
        if is_share and _LEAST_PERCENT <= value <= _PERCENT:
            return f"expected a share, at most 1, got {value:g}: did you mean {value / _PERCENT:g}?"

    expected = _expected(problem, section)
    if isinstance(value, tuple):  # lists of numbers become tuples
        value = list(value)
    return f"{expected[0].lower()}{expected[1:]}, got {_short(repr(value))}"


def _expected(problem: Mapping[str, Any], section: type[BaseModel]) -> str:
    """Return what was expected in place of a value."""
    kind = problem["type"]
    if kind in _NO_NUMBER:
        return _number_in_words(problem, section)
    if kind in _EXPECTED:
        return _EXPECTED[kind].format(**problem.get("ctx", {}))
    text: str = problem["msg"]
    return text.replace("Input should be", "expected")


def _number_in_words(problem: Mapping[str, Any], section: type[BaseModel]) -> str:
    """Return the number that a key expects, with its unit, in words."""
    names = names_of(section)
    keys = [part for part in problem["loc"] if part in names]
    if not keys:
        return "expected a number"
    name = names[keys[-1]]
    unit = unit_of(name, section.model_fields[name])
    return f"expected a number in {unit}" if unit else "expected a number"


def _short(text: str) -> str:
    """Return a text of at most `_LONGEST_SHOWN` characters."""
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."
