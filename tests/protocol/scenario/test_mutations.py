"""Mutations of scenarios that the campaign draws: of every kind, and the same for a seed."""

import random
import tomllib
from collections import Counter
from typing import Any

from tests.support.mutations import SYNTAX, UNWRITABLE, mutated
from tests.support.runs import PAPER

SEEDS = range(500)
KINDS = {"magnitude", "text", "type", "list", "key", SYNTAX}
FEWEST = 20  # of each kind


def paper() -> dict[str, Any]:
    """Return the tree of the paper's scenario."""
    return tomllib.loads(PAPER.read_text(encoding="utf-8"))


def draw(tree: dict[str, Any], seed: int) -> tuple[bytes, str]:
    """Return the mutation of a seed."""
    return mutated(tree, random.Random(seed))  # noqa: S311  # no secret


def test_every_kind_occurs() -> None:
    """Mutations of each kind are drawn; those of the tree are TOML."""
    tree = paper()
    kinds: Counter[str] = Counter()
    for seed in SEEDS:
        content, kind = draw(tree, seed)
        kinds[kind] += 1
        if kind != SYNTAX:
            assert tomllib.loads(content.decode())
    assert kinds.keys() == KINDS
    assert min(kinds.values()) >= FEWEST
    assert tree == paper()


def test_a_seed_gives_the_same_bytes() -> None:
    """Other seeds give others."""
    twice = [[draw(paper(), seed) for seed in SEEDS] for _ in range(2)]
    assert twice[0] == twice[1]
    assert len({content for content, _ in twice[0]}) > len(SEEDS) // 2


def test_a_tree_that_is_no_toml_is_of_a_kind_of_its_own() -> None:
    """Its text is empty, and it is not counted among mutations of another kind."""
    results = [draw(paper() | {"name": object()}, seed) for seed in SEEDS]
    contents = {content for content, kind in results if kind == UNWRITABLE}
    assert contents == {b""}
    assert all(content or kind in (SYNTAX, UNWRITABLE) for content, kind in results)
