"""Random mutations of scenarios.

Of values, types, lists, keys and of the TOML text; each drawn from a seed.
"""

import copy
import random
from collections.abc import Callable
from typing import Any

import tomli_w

from tests.support.drawn_settings import KEYS, choices

# Values that mutations put in place of others.
_NUMBERS: tuple[Any, ...] = (
    0, 0.0, -0.0, -1, -1.0, 1, 2, 0.5, 1e-3, 1e-6, 1e-9, 1e-11, 1e-13, 1e-30, 5e-324, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6,
    1e8, 1e9, 5e11, 1e12, 1e13, 1e30, 1e150, 1e308, -1e308, float("inf"), float("-inf"), float("nan"),
    255, 256, 65_536, 2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63),
)  # fmt: skip
_STRINGS = (
    "", " ", "\0", "a\0b", "x" * 100_000, "ü", "\U0001d54f", "\u202e", "\x1b[31m", "\n", "a\nb", "..",
    "../../etc/passwd", "/", "/dev/zero", "/dev/null", "/dev/tty", "/proc/self/mem", "no.csv", "agent0",
    "agent9", "agent1", "plant", "coordinator", "recorder", "uav1", "uav99",
    "(" * 5_000, "-" * 5_000, "1+" * 3_000 + "1", "thrust1 <= 40", "r0[2] <= 1e400",
    "r0[9] <= 1", "1/0 <= 1", "9**9**9**9 <= 1", "sqrt(-1) <= r0[0]", "r0[0] == 0", "__import__('os')", "v0[0]",
    "e1[0]*1e300", "log(r0[0])", "tcp/127.0.0.1:1", "tls/x:99999999", "192.0.2.1", "not a host", "localhost",
    *dict.fromkeys(word for field in KEYS.values() for word in choices(field.annotation) if isinstance(word, str)),
)  # fmt: skip
_OTHERS: tuple[Any, ...] = (
    True,
    False,
    [],
    {},
    [[]],
    [1, 2, 3],
    [0.0, 0.0, 0.0],
    [[1.0, 0.0], [0.0]],
    {"a": 1},
)

# Sections that few scenarios have, to be mutated as well.
_ADDED: tuple[tuple[tuple[str, ...], Any], ...] = (
    (("links",), {"delay_s": 0.1, "jitter_s": 0.05, "loss": 0.1, "duplicate": 0.1, "reorder": 0.1, "reorder_s": 0.1}),
    (("links",), {"gilbert_elliott": {"enter": 0.1, "leave": 0.2, "loss": 0.9}, "rate_hz": 10.0}),
    (("links",), {"override": [{"from": "agent1", "to": "agent2", "delay_s": 0.2, "distribution": "normal"}]}),
    (("links",), {"partition": [{"between": ["agent1"], "start_s": 0.0, "end_s": 1.0}]}),
    (("links",), {"change": [{"at_s": 0.1, "loss": 0.2}, {"at_s": 0.2, "to": "plant", "delay_s": 0.1}]}),
    (("links",), {"distribution": "empirical", "samples_s": "delays.csv"}),
    (("faults",), {"event": [{"at_s": 0.1, "do": "kill", "target": "agent2"}]}),
    (("faults",), {"event": [{"at_s": 0.1, "do": "motor_off", "target": "uav1"}]}),
    (("faults",), {"event": [{"at_s": 0.1, "do": "release", "target": "uav3"}]}),
    (("plant", "wind"), {"speed_mps": [5.0, 0.0, 0.0], "gust_mps": [1.0, 1.0, 0.5], "gust_time_constant_s": 1.0}),
    (("plant", "noise"), {"position_m": 0.01, "velocity_mps": 0.02, "attitude_rad": 0.01, "rod_direction_rad": 0.01}),
    (("plant",), {"step_s": 0.01, "tolerance": 1e-9, "payload_mass_factor": 1.2, "max_error_m": 20.0}),
    (("controller", "constraint"), [{"expression": "thrust1 + thrust2 <= 60"}, {"expression": "r0[2] <= -2"}]),
    (("controller", "cost"), [{"expression": "v0[0]", "weight": 0.5}]),
    (("controller", "separation"), {"minimum_m": 0.3, "penalty": 50.0}),
    (("controller", "tilt"), {"limit_deg": 20.0, "penalty": 10.0}),
    (("controller", "disturbance"), {"estimate": True, "time_constant_s": 0.5}),
    (("controller",), {"negotiation_iterations": 3, "relaxation": "auto", "share": "always", "share_heartbeat_s": 1.0}),
    (("agents",), {"owned": [[1, 2], [3, 4]]}),
    (("agents",), {"owned": [[1, 2, 3, 4]]}),
    (("clock",), {"mode": "realtime", "speed": 1.0, "overrun_limit": 3, "overrun_limit_s": 0.1, "on_overrun": "hold"}),
    (("clock",), {"on_agent_loss": "continue", "barrier_timeout_s": 2.0, "join_timeout_s": 5.0}),
    (("maneuver",), {"profile": "min_jerk", "phase": [{"name": "path", "file": "path.csv"}]}),
    (("system",), {"gravity_mps2": 3.7}),
)  # fmt: skip

Tree = dict[str, Any]

# Kinds beside those of mutations of the tree: a defect of the text; a tree that TOML cannot have.
SYNTAX = "syntax"
UNWRITABLE = "unwritable"


def mutated(tree: Tree, rng: random.Random) -> tuple[bytes, str]:
    """Return a scenario with one to three mutations as the bytes of a TOML file, and a kind.

    The kind is that of the last mutation, of a defect of the text, or `UNWRITABLE`.
    """
    tree, kind = copy.deepcopy(tree), ""
    for _ in range(rng.choice((0, 1, 1, 2))):
        _put(tree, *copy.deepcopy(rng.choice(_ADDED)))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kind = rng.choice((*_TREE, "magnitude", "magnitude"))
        _TREE[kind](tree, rng)
    try:
        text = tomli_w.dumps(tree)
    except (TypeError, ValueError):
        return b"", UNWRITABLE
    if rng.random() < 0.15:
        return _broken(text.encode(), rng), SYNTAX
    return text.encode(), kind


def _put(tree: Tree, path: tuple[str, ...], content: Any) -> None:
    """Put content at a path, keys of a section beside those that it has."""
    node: Any = tree
    for key in path[:-1]:
        node = node.setdefault(key, {})
    last = path[-1]
    if isinstance(content, dict) and isinstance(node.get(last), dict):
        node[last].update(content)
    else:
        node[last] = content


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Return container and key of everything below a node."""
    items = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    return [place for key, child in items for place in [(node, key), *_places(child)]]


def _choose(tree: Tree, rng: random.Random, *types: type) -> tuple[Any, Any]:
    """Return container and key of a random value of some types, by default of any.

    All values are equally likely. Without one it is the name of the scenario.
    """
    places = [
        (node, key) for node, key in _places(tree) if isinstance(node[key], types) or not types
    ]
    return rng.choice(places) if places else (tree, "name")


def _magnitude(tree: Tree, rng: random.Random) -> None:
    node, key = _choose(tree, rng, int, float)
    value = node[key]
    scaled = isinstance(value, int | float) and rng.random() < 0.7
    if scaled:
        factor = 10.0 ** rng.choice((rng.uniform(-1, 1), rng.uniform(-4, 4), rng.uniform(-15, 15)))
        node[key] = (
            round(value * factor)
            if isinstance(value, int) and rng.random() < 0.8
            else value * factor
        )
    else:
        node[key] = rng.choice(_NUMBERS)


def _text(tree: Tree, rng: random.Random) -> None:
    node, key = _choose(tree, rng, str)
    node[key] = rng.choice(_STRINGS)


def _type(tree: Tree, rng: random.Random) -> None:
    node, key = _choose(tree, rng)
    node[key] = copy.deepcopy(rng.choice((*_NUMBERS, *_STRINGS, *_OTHERS)))


def _list(tree: Tree, rng: random.Random) -> None:
    node, key = _choose(tree, rng, list)
    entries = node[key]
    if not isinstance(entries, list):
        return
    changed: tuple[list[Any], ...] = (
        [],
        entries * 2,
        entries * 300,
        entries[::-1],
        entries[:-1],
        [*entries, copy.deepcopy(rng.choice(_OTHERS))],
        [entries],
        [*entries, rng.choice(_NUMBERS)],
        rng.sample(entries, len(entries)),
    )
    node[key] = copy.deepcopy(rng.choice(changed))


def _key(tree: Tree, rng: random.Random) -> None:
    node, key = _choose(tree, rng)
    if not isinstance(node, dict):
        return
    value = node[key]
    match rng.randrange(4):
        case 0:
            del node[key]
        case 1:
            node[f"{key}{rng.choice('xs_')}"] = node.pop(key)
        case 2:
            node[rng.choice(_STRINGS)[:100]] = copy.deepcopy(value)
        case _:
            other, place = _choose(tree, rng)
            if isinstance(other, dict) and not isinstance(value, dict):
                other[key] = copy.deepcopy(value)
            else:
                other[place] = copy.deepcopy(rng.choice(_OTHERS))


_TREE: dict[str, Callable[[Tree, random.Random], None]] = {
    "magnitude": _magnitude,
    "text": _text,
    "type": _type,
    "list": _list,
    "key": _key,
}


def _broken(content: bytes, rng: random.Random) -> bytes:
    """Return a TOML file with a defect in its text."""
    at = rng.randrange(len(content) + 1)
    lines = content.split(b"\n")
    line = rng.randrange(len(lines))
    defects: tuple[Callable[[], bytes], ...] = (
        lambda: content[:at],
        lambda: content[:at] + bytes([rng.randrange(256)]) + content[at + 1 :],
        lambda: content[:at] + rng.randbytes(8) + content[at:],
        lambda: b"\n".join([*lines[:line], *lines[line + 1 :]]),
        lambda: b"\n".join([*lines[: line + 1], *lines[line:]]),
        lambda: b"\xef\xbb\xbf" + content,
        lambda: b"\xff\xfe" + content.decode().encode("utf-16-le"),
        lambda: content.replace(b"\n", b"\r\n"),
        lambda: content.replace(b"=", b":", 1),
        lambda: content + b"\na = " + b"[" * 3_000,
        lambda: content + b"\na = " + b"{b=" * 3_000,
        lambda: content + b"\n" + b".".join([b"a"] * 3_000) + b" = 1\n",
        lambda: content.replace(b"mass_kg = ", b"mass_kg = 1e99999 # ", 1),
        lambda: content.replace(b"seed", b"seed = 1" + b"0" * 5_000 + b" #", 1),
        lambda: b"seed = 1979-05-27T07:32:00Z\n" + content,
        lambda: b"",
    )
    return rng.choice(defects)()
