"""Errors of scenarios: one line with file, field, what was expected and what came, also from pydantic's problems."""

import difflib
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from model.arrays import ShapeError
from model.parameters import ParameterError
from mpc.feedback import FeedbackError
from mpc.settings import SettingsError
from protocol.scenario.keys import names_of, section_in
from protocol.scenario.schema import Scenario
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_SCENARIO

T = TypeVar("T")


class ScenarioError(TransportError, ValueError):
    """An invalid scenario: `file or option: field: expected ..., got ...`.

    The field is the dotted path of the key, list entries counted from 1; it may be empty.
    """

    exit_code = EXIT_SCENARIO

    def __init__(self, source: str, field: str, problem: str) -> None:
        text = ": ".join(part for part in (source, field, problem) if part)
        super().__init__(" ".join(text.splitlines()))
        self.field, self.problem = field, problem

    def blaming(self, settings: Sequence[str]) -> "ScenarioError":
        """Return the same error, with the settings in place of the file if they gave the field or part of it."""
        given: list[str] = []
        for setting in reversed(settings):
            key = key_of(setting)
            around = f"{self.field}.".startswith(f"{key}.")
            if around or key.startswith(f"{self.field}."):
                given.insert(0, setting)
            if around:
                break  # it replaced all that settings before it had given
        if not given:
            return self
        field = "" if [key_of(setting) for setting in given] == [self.field] else self.field
        return ScenarioError(" ".join(map(option, given)), field, self.problem)


def building(source: str, field: str, build: Callable[[], T]) -> T:
    """Return a model object built from a scenario's values; its errors become a `ScenarioError` of that field."""
    try:
        return build()
    except (FeedbackError, ParameterError, SettingsError, ShapeError) as error:
        raise ScenarioError(source, field, str(error)) from error


def key_of(setting: str) -> str:
    """Return the dotted key of a setting "key=value"."""
    return setting.partition("=")[0].strip()


class PythonSetting(str):
    """A setting "key=value" that was given in Python, where errors do not name an option of the command line."""

    __slots__ = ()


def option(setting: str) -> str:
    """Return a setting as it was given on the command line or in Python, shortened when it is long."""
    text = _short(setting) or repr(setting)
    return text if isinstance(setting, PythonSetting) else f"--set {text}"


def _short(text: str) -> str:
    return text if len(text) <= 80 else text[:77] + "..."


def first_problem(error: ValidationError, source: str, root: type[BaseModel] = Scenario) -> ScenarioError:
    """Return the first problem that pydantic found in a section `root`, as one line in the project's words."""
    # Unknown keys first: a mistyped key is also a missing one, and the typo tells more.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    problem = problems[0]
    *above, last = problem["loc"]
    # Pydantic names the branch of a union it tried; an unknown key may be called anything and comes last.
    known_last = problem["type"] == "extra_forbidden" or not _is_union_branch(last)
    location = [part for part in above if not _is_union_branch(part)] + ([last] if known_last else [])
    field = ".".join(str(part + 1) if isinstance(part, int) else part for part in location)
    kind, context, value = problem["type"], problem.get("ctx", {}), problem["input"]
    if kind == "extra_forbidden":
        known = _known_keys(root, location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return ScenarioError(source, field, f"unknown key; {hint}")
    if kind == "missing":
        return ScenarioError(source, field, "expected a value, got nothing")
    message = problem["msg"]
    expected = f"expected {_WORDS[kind].format(**context)}" if kind in _WORDS else message[0].lower() + message[1:]
    shown = list(value) if isinstance(value, tuple) else value  # lists of numbers become tuples
    return ScenarioError(source, field, f"{expected}, got {_short(repr(shown))}")


_WORDS = {
    "greater_than": "a number > {gt}",
    "greater_than_equal": "a number >= {ge}",
    "less_than": "a number < {lt}",
    "less_than_equal": "a number <= {le}",
    "too_short": "at least {min_length} list entries",
    "too_long": "at most {max_length} list entries",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "text matching {pattern}",
    "int_type": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "model_type": "a section",
    "dict_type": "a section",
}


def _is_union_branch(part: int | str) -> bool:
    """Return whether a part of an error's location is not a key but a type that was tried."""
    return isinstance(part, str) and (part in ("float", "constrained-float", "int", "str") or "[" in part)


def _known_keys(section: type[BaseModel], location: Iterable[int | str]) -> list[str]:
    for part in location:
        if not isinstance(part, int):
            section = section_in(section.model_fields[part].annotation) or Scenario
    return list(names_of(section))
