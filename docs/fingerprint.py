"""Fingerprints of runs: of a scenario with its seed, of the code, and of the machine's rounding.

Results are kept by the first two. A scenario has the same fingerprint as long as it gives the same
values to the same keys: a key that is added with a default, and a comment, do not change it.
"""

import ast
import hashlib
import io
import json
import tokenize
from functools import cache
from importlib import metadata

import threadpoolctl
from tables import ROOT

from transport.agent.user_class.user_planner import controller_versions
from transport.model.kernels import compiler, native
from transport.plant.engines import engine_version
from transport.protocol.scenario.sections.schema import Scenario

# Sources that decide the numbers of a run in memory.
SOURCES = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator"),
    *("transport/flight/memory.py", "transport/analysis", "transport/experiments/cases.py"),
)
# Those of processes and networks, which runs in memory do not have.
_OF_PROCESSES = ("protocol/network/", "/main.py")
_PACKAGES = ("numpy", "scipy", "casadi", "daqp", "clarabel", "msgspec")


def run_id(scenario: Scenario) -> str:
    """Return the fingerprint of a scenario with its seed, without addresses and defaults."""
    tree = scenario.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    tree.pop("network", None)
    text = json.dumps(tree, sort_keys=True).replace(f"{ROOT}/", "")
    return _digest(text, 12)


def code_id(scenario: Scenario) -> str:
    """Return the fingerprint of what computes a run: sources, packages, engine, own controller."""
    engine = scenario.plant.engine
    has_firmware = scenario.plant.inner_loop == "betaflight"
    parts = [
        _sources(),
        *(f"{package} {metadata.version(package)}" for package in _PACKAGES),
        "" if engine == "rods" else engine_version(engine),  # that of the package is in the sources
        controller_versions(scenario),
        firmware_version() if has_firmware else "",
    ]
    return _digest("\n".join(parts), 8)


def firmware_version() -> str:
    """Return the version of the flight firmware, which an extra of its own installs; empty without it."""
    try:
        return metadata.version("betaflight")
    except metadata.PackageNotFoundError:
        return ""


@cache
def rounding_id() -> str:
    """Return the fingerprint of how this machine rounds: processor, kernels and BLAS."""
    processor = compiler.compiled_file("processor", b"", ()).name
    pools = threadpoolctl.threadpool_info()
    libraries = {
        f"{pool['architecture']} {pool['version']}" for pool in pools if pool["user_api"] == "blas"
    }
    return _digest("\n".join([processor, str(native.AVAILABLE), *sorted(libraries)]), 8)


@cache
def _sources() -> str:
    """Return the fingerprint of all sources without comments and docstrings."""
    digest = hashlib.sha256()
    for place in SOURCES:
        path = ROOT / place
        files = [path] if path.is_file() else sorted(path.rglob("*.[cp]*"))
        for file in files:
            name = file.relative_to(ROOT).as_posix()
            if file.suffix not in {".py", ".c"} or any(part in name for part in _OF_PROCESSES):
                continue
            text = file.read_text(encoding="utf-8")
            digest.update(name.encode())
            digest.update((essential(text) if file.suffix == ".py" else text).encode())
    return digest.hexdigest()


def essential(source: str) -> str:
    """Return Python code without comments, docstrings, empty lines and spaces at line ends."""
    lines = [[*line] for line in source.splitlines()]
    for first, last in _not_computing(source):
        for number in range(first[0], last[0] + 1):
            line = lines[number - 1]
            begin = first[1] if number == first[0] else 0
            end = last[1] if number == last[0] else len(line)
            line[begin:end] = " " * (end - begin)
    texts = ["".join(line).rstrip() for line in lines]
    return "\n".join(text for text in texts if text)


Place = tuple[int, int]  # line, from 1, and column


def _not_computing(source: str) -> list[tuple[Place, Place]]:
    """Return begin and end of each comment and docstring."""
    reader = io.StringIO(source).readline
    places = [
        (token.start, token.end)
        for token in tokenize.generate_tokens(reader)
        if token.type == tokenize.COMMENT
    ]
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            last = node.end_lineno or node.lineno
            places.append(
                (
                    (node.lineno, _characters(lines[node.lineno - 1], node.col_offset)),
                    (last, _characters(lines[last - 1], node.end_col_offset or 0)),
                )
            )
    return places


def _characters(line: str, offset: int) -> int:
    """Return a column in characters for one in bytes of UTF-8."""
    return len(line.encode()[:offset].decode())


def _digest(text: str, length: int) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:length]
