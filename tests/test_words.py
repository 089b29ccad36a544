"""Words of code and docs: no vague pronouns, no sentence fragments at the beginning, one term for each thing."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

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
PAGES = [path for path in FILES if path.suffix == ".md"] + sorted((ROOT / ".github").rglob("*.md"))
TABLES = [path for path in FILES if path.suffix == ".toml"]

# What a page quotes is not prose: blocks and spans of code, formulas, targets of links.
QUOTED = re.compile(r"^ *```.*?^ *```|`[^`\n]+`|\$\$.*?\$\$|\$[^$\n]+\$|(?<=\])\([^)\s]+\)", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """A wording that the project replaces by the term of the field.

    Attributes:
        wrong: Pattern of the wording, upper or lower case.
        say: Term to use instead.
        refused: Example that the pattern finds.
        accepted: Similar text that it does not find.
    """

    wrong: str
    say: str
    refused: str
    accepted: str


TERMS = (
    Term(
        wrong=r"\bas printed\b",
        say="as published",
        refused="the algorithm as printed",
        accepted="the digest is printed by the command",
    ),
    Term(
        wrong=r"\b(pric(e[sd]?|ing)|paid for)\b",
        say="weight, penalty",
        refused="the price of a violation",
        accepted="the penalty of a violation",
    ),
    Term(
        wrong=r"(?<!ground )\btruths?\b",
        say="ground truth, plant state",
        refused="the estimate is close to the truth",
        accepted="the estimate is close to the ground truth",
    ),
    Term(
        wrong=r"\brounds? of negotiation|\bnegotiation rounds?\b|\b(both|two|three|more|all|per|several) rounds\b",
        say="iteration",
        refused="after two rounds of negotiation",
        accepted="both ends of the range round to the same number of round trips",
    ),
    Term(
        wrong=r"\bpictures? (a|per) second\b|\b(torn|half|whole) pictures?\b",
        say="frame",
        refused="10 pictures a second",
        accepted="10 frames a second, and pictures in the README",
    ),
    Term(
        wrong=r"\blossy\b",
        say="with packet loss",
        refused="over a lossy network",
        accepted="over a network with packet loss",
    ),
    Term(
        wrong=r"\b(fly|flies|flew|flown|flying) (it|them|scenarios|runs|an? (scenario|run)"
        r"|the (paper|scenario|run|experiment|maneuver))\b",
        say="run, simulate",
        refused="this flies it and records it",
        accepted="four UAVs fly on without the released one, and the UAV flies the rest of its plan",
    ),
    Term(
        wrong=r"\blost (runs?|flights?)\b|\b(runs?|flights?) (is |are |was |were )?lost\b|\blost at (t = )?\d",
        say="diverged",
        refused="two lost runs, the first lost at 5.8 s",
        accepted="two runs with lost plans, one lost at this tick",
    ),
    Term(
        wrong=r"\bpromis(e[sd]?|ing)\b",
        say="guaranteed",
        refused="no more is promised",
        accepted="no more is guaranteed",
    ),
    Term(
        wrong=r"\bthan (they|it|the controllers?|the agents?|agents?) knows?\b",
        say="actual, estimated",
        refused="a payload heavier than they know",
        accepted="an unmodelled payload mass of which agents know an estimate",
    ),
    Term(
        wrong=r"\b(shared|the|this|same|another) laws?\b",
        say="control law, feedback gain",
        refused="the inputs follow the shared law",
        accepted="the inputs follow the shared control law, and conservation laws hold",
    ),
    Term(
        wrong=r"\bwhat came of\b|\bgone on with\b|\bgets? round to\b|\bbeyond all bounds\b|\btheir minds?\b"
        r"|\bplans? (flies|fly|flew)\b",
        say="plain technical English",
        refused="an experiment is gone on with, and the report says what came of it",
        accepted="an experiment is resumed, and the report has its results",
    ),
)


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


def strings(tree: ast.Module) -> Iterator[str]:
    """Yield docstrings, help texts and messages: all strings with more than one word, with 0 for inserted values."""
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "0" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value


@cache
def wordings() -> list[tuple[str, str]]:
    """Return file and text of every page, table of keys, docstring, help text and message, each on one line."""
    found = [(named(path), path.read_text(encoding="utf-8")) for path in [*PAGES, *TABLES]]
    for path in SOURCES:
        if path != Path(__file__).resolve():  # it quotes the wordings
            found += [(named(path), text) for text in strings(ast.parse(path.read_text(encoding="utf-8")))]
    return [(name, " ".join(QUOTED.sub("", text).split())) for name, text in found]


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.say)
def test_terms_of_the_field(term: Term) -> None:
    """Pages, docstrings, help texts and messages have the field's term."""
    wrong = re.compile(term.wrong, re.IGNORECASE)
    found = [
        f"{name}: {text[max(0, match.start() - 40) : match.end() + 40]} (say: {term.say})"
        for name, text in wordings()
        for match in wrong.finditer(text)
    ]
    assert found == []


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.say)
def test_each_term_can_be_missed(term: Term) -> None:
    """Each pattern finds its wording, in any case, and not a text that only resembles it."""
    wrong = re.compile(term.wrong, re.IGNORECASE)
    assert wrong.search(term.refused)
    assert wrong.search(term.refused.upper())
    assert not wrong.search(term.accepted)


def test_every_kind_of_text_is_read() -> None:
    """Pages, keys, docstrings, help texts and errors are among the texts, without the code and formulas they quote."""
    for name, text in (
        ("CHANGELOG.md", "newest version first"),
        ("docs/equations.md", "### Shared control law"),
        (".github/pull_request_template.md", "CHANGELOG.md"),
        ("protocol/scenario/keys.toml", "standard deviation of the gusts"),
        ("protocol/wire/codec.py", "protocol version 0, expected 0"),
        ("transport/cli/options.py", "Change a scenario value"),
    ):
        assert any(text in found for file, found in wordings() if file == name), name
    equations = next(text for name, text in wordings() if name == "docs/equations.md")
    assert not re.search(r"\\tag|\\frac|model\.dynamics", equations)
