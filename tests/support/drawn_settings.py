"""Settings of any key of the schema of scenarios, with any value (Hypothesis)."""

import re
import tomllib
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

import tomli_w
from hypothesis import strategies as st

from tests.support.runs import PAPER
from transport.protocol.scenario.sections.scenario_keys import (
    fields,
    is_list,
    names_of,
    section_in,
)
from transport.protocol.scenario.sections.schema import Scenario

KEYS = fields(Scenario)
_PAPER_TREE = tomllib.loads(PAPER.read_text(encoding="utf-8"))


def setting_of(key: str, value: str) -> str:
    """Return the setting of a key, of the first entry in lists; a list that the file lacks is given whole."""
    names = key.split(".")
    node: Any = _PAPER_TREE
    place: list[str] = []
    for i, name in enumerate(names[:-1], start=1):
        place.append(name)
        node = node.get(name, {})
        if is_list(Scenario, place):
            if not node:
                return f"{'.'.join(place)}=[{{{'.'.join(names[i:])}={value}}}]"
            place.append("1")
            node = node[0]
    return f"{'.'.join([*place, names[-1]])}={value}"


def choices(annotation: Any) -> Iterator[Any]:
    """Yield the words of all choices in an annotation."""
    if get_origin(annotation) is Literal:
        yield from get_args(annotation)
    else:
        for inner in get_args(annotation):
            yield from choices(inner)


# Any value that TOML can have.
PLAIN: st.SearchStrategy[Any] = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.datetimes() | st.times(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", min_size=1), inner, max_size=2)
    ),
    max_leaves=5,
)
_SIMPLE: dict[Any, st.SearchStrategy[Any]] = {
    float: st.floats(),
    int: st.integers(-3, 10**6),
    bool: st.booleans(),
}


def _values(annotation: Any) -> st.SearchStrategy[Any]:
    """Return values of the type of a field, which may be out of its range or of another length."""
    inner, section = get_args(annotation), section_in(annotation)
    if get_origin(annotation) is Literal:
        return st.sampled_from(inner)
    if get_origin(annotation) in (list, tuple):
        return st.lists(_values(inner[0]), max_size=4)
    if section is not None:
        return st.dictionaries(st.sampled_from([*names_of(section)]), PLAIN, max_size=3)
    if inner:
        return st.one_of([_values(one) for one in inner])
    return _SIMPLE.get(annotation, PLAIN)


def _in_toml(value: Any) -> str:
    """Return a value as TOML has it behind a key."""
    within = re.fullmatch(
        r"x = \[\s*\[\s*(.*),\s*\],\s*\]\s*", tomli_w.dumps({"x": [[value]]}), re.DOTALL
    )
    assert within is not None
    return within[1]


@st.composite
def settings(draw: st.DrawFn) -> str:
    """Return a setting of any key with a value of its type, or with any."""
    key = draw(st.sampled_from([*KEYS]))
    return setting_of(key, _in_toml(draw(_values(KEYS[key].annotation) | PLAIN)))
