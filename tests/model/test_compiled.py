"""Compiled models on disk: the cache may be missing or unwritable, and never changes a bit of a result."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from model.arrays import Array
from model.compiled import Compiled, _loaded, functions
from tests.support.random_systems import random_forces, random_input, random_state, random_system

N = 2


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder that this test alone uses; it does not exist yet."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(folder))
    return folder


def only_file(folder: Path) -> Path:
    """The one file in the cache: nothing temporary is left behind."""
    (file,) = folder.iterdir()
    return file


def results(built: dict[str, ca.Function]) -> list[Array]:
    """Every output of every function at one random point."""
    rng = np.random.default_rng(2700)
    p = random_system(rng, N).vector()
    x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
    arguments: dict[str, tuple[Array | float, ...]] = {
        "derivative": (x, u, p, F),
        "tensions": (x, u, p, F),
        "velocities": (x, p),
        "outputs": (x, p),
        "linearise": (x, u, p, F),
        "step": (x, u, p, F, 0.05),
        "sense": (x, u, p, F),
        "sensed": (x, u, p, F),
    }
    assert built.keys() == arguments.keys()
    return [array for name, function in built.items() for array in Compiled(function)(*arguments[name])]


def assert_same_bits(first: dict[str, ca.Function], second: dict[str, ca.Function]) -> None:
    """Every output equal in every bit."""
    for one, other in zip(results(first), results(second), strict=True):
        assert one.tobytes() == other.tobytes()


def test_cached_functions_give_the_same_bits(cache: Path) -> None:
    """The first process builds, the next loads: a fleet may mix both and must stay reproducible."""
    fresh = functions(N)
    written = only_file(cache).read_bytes()
    _loaded.cache_clear()
    loaded = functions(N)
    assert_same_bits(fresh, loaded)
    assert only_file(cache).read_bytes() == written


def test_folder_that_cannot_be_made_costs_only_time(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cache path below a regular file can be neither read nor created, by root neither: built in memory."""
    fresh = functions(N)
    blocker = tmp_path / "file"
    blocker.write_text("not a folder", encoding="utf-8")
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(blocker / "cache"))
    assert_same_bits(fresh, functions(N))
    assert blocker.read_text(encoding="utf-8") == "not a folder"


def test_compiled_functions_take_exactly_their_arguments() -> None:
    """Arrays of the wrong length are refused; a missing argument raises instead of reusing the last one."""
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b")
    scale = Compiled(ca.Function("scale", [a, b], [a * b, ca.vertcat(a.T, b * a.T)]))
    vector, matrix = scale(np.array([1.0, 2.0]), 3.0)
    assert np.array_equal(vector, [3.0, 6.0])
    assert np.array_equal(matrix, [[1.0, 2.0], [3.0, 6.0]])
    with pytest.raises(ValueError, match="broadcast"):
        scale(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="zip"):
        scale(np.zeros(2))
