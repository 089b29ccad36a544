"""Words of code and docs: no vague pronouns, no docstring or help text that begins as a fragment."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Built from two parts, so that this file does not contain the words.
VAGUE = re.compile(rf"\b(who{'ever'}|(some|no|every|any){'body'})\b", re.IGNORECASE)
FRAGMENT = re.compile(r"(Of|What|Who\w*)\b")
FOLDERS = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "transport"),
    *("deploy", "scenarios", "benchmarks", "docs", "tests"),
)
SUFFIXES = {".py", ".md", ".toml", ".c", ".json", ".service", ".sh", ".yaml"}
FILES = sorted(
    [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in SUFFIXES]
    + [path for path in ROOT.iterdir() if path.suffix in SUFFIXES]
)
SOURCES = [path for path in FILES if path.suffix == ".py"]


def named(path: Path) -> str:
    """Return a path relative to the project."""
    return path.relative_to(ROOT).as_posix()


def texts(tree: ast.Module) -> Iterator[str]:
    """Yield the docstrings of a module and the values of all arguments `help`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
        elif isinstance(node, ast.keyword) and node.arg == "help" and isinstance(node.value, ast.Constant):
            yield str(node.value.value)


def test_the_walk_sees_the_project() -> None:
    """Code and docs are among the files."""
    assert {"README.md", "docs/time.md", "agent/node.py", "model/kernels.c"} <= set(map(named, FILES))


def test_no_vague_pronouns() -> None:
    """Sentences name the thing: agent, process, message, user."""
    found = []
    for path in FILES:
        lines = path.read_text(encoding="utf-8").splitlines()
        found += [f"{named(path)}: {line}" for line in lines if VAGUE.search(line)]
    assert found == []


def test_docstrings_and_help_begin_with_their_subject() -> None:
    """Docstrings and help texts are imperatives or noun phrases, not fragments of a question."""
    found = []
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found += [f"{named(path)}: {text.splitlines()[0]}" for text in texts(tree) if FRAGMENT.match(text)]
    assert found == []
