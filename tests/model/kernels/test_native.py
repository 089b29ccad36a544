"""Compiled kernels against their equivalents in Python, and the behaviour without a compiler."""

import ctypes
import os
import platform
import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import pytest

from tests.support.random_systems import random_forces, random_input, random_state, random_system
from tests.support.runs import completed, ready
from tests.support.same_flight import flight_bits
from tests.support.systems import ring
from transport.model.arrays import ShapeError
from transport.model.kernels import casadi_functions, compiler, native
from transport.model.kernels.casadi_functions import Compiled, compile_functions, functions
from transport.model.kernels.compiled_step import Feedback
from transport.model.linear.discretisation import by_exponential, zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.physics import dynamics, outputs_and_sensors, projection_of_rods
from transport.model.physics.hover import hover
from transport.mpc.program.prediction import free_response

needs_compiler = pytest.mark.skipif(
    compiler.find_compiler() is None, reason="no C compiler on this machine"
)
needs_kernels = pytest.mark.skipif(
    not native.AVAILABLE, reason="no compiled kernels: no C compiler, or switched off"
)

CLIMB = "maneuver.phase=[{name='climb',duration_s=1.0,displacement_m=[0.5,0,-1.0]}]"

# Sums of the same products in another order: rounding, relative to the largest entry.
ROUNDING = 1e-13

# Around the width of a vector, of four, of eight; with zeros, as a mechanical system has, and
# without.
SIZES = [1, 2, 7, 8, 9, 24, 33, 60, 65]


def linearisation(n: int, m: int, filled: float, growth: float, seed: int) -> Linearisation:
    """A random expansion, its factors unknown."""
    rng = np.random.default_rng(seed)
    A_c = np.where(rng.random((n, n)) < filled, rng.standard_normal((n, n)), 0.0)
    A_c *= growth / max(1e-9, float(np.abs(A_c).sum(axis=0).max()))
    return Linearisation.of(
        rng.standard_normal(n), A_c, rng.standard_normal((n, m)), np.zeros(1), np.zeros((1, n))
    )


@needs_kernels
@pytest.mark.usefixtures("vector_width")
@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize(("filled", "growth"), [(1.0, 1.0), (0.2, 8.0), (0.0, 1.0), (0.5, 100.0)])
def test_zero_order_hold_is_its_twin(n: int, filled: float, growth: float) -> None:
    """A, B and f_d of any size, full or sparse, short period or one that is halved many times."""
    linear = linearisation(n, 1 + n % 5, filled, growth, seed=n)
    found, expected = zero_order_hold(linear, 0.5), by_exponential(linear, 0.5)
    # Doubling back adds rounding at each step, and the twin doubles in another order.
    within = ROUNDING * max(1.0, growth)
    for one, other in ((found.A, expected.A), (found.B, expected.B), (found.f_d, expected.f_d)):
        assert one.shape == other.shape
        assert np.abs(one - other).max() <= within * max(1.0, float(np.abs(other).max()))


@needs_kernels
@pytest.mark.parametrize("name", ["paper", "centralized", "precise"])
def test_each_vector_width_gives_the_same_bits(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of summation does not depend on the width: plant states and plans of a flight are equal."""
    flights = []
    for width in ("2", "4", "8"):
        monkeypatch.setenv("PAYLOAD_TRANSPORT_NATIVE", width)
        monkeypatch.setattr(native, "KERNELS", native.load())
        flights.append(flight_bits(completed(ready(name, CLIMB))))
    assert flights[0] == flights[1] == flights[2]


def test_a_width_that_does_not_exist_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The warning names the variable, its value, and what is expected; the processor's width is used."""
    monkeypatch.delenv("PAYLOAD_TRANSPORT_NATIVE", raising=False)
    usual = compiler.processor_flags()
    monkeypatch.setenv("PAYLOAD_TRANSPORT_NATIVE", "3")
    with pytest.warns(RuntimeWarning, match="PAYLOAD_TRANSPORT_NATIVE=3: expected 0 .*2, 4 or 8"):
        assert compiler.processor_flags() == usual


@pytest.mark.parametrize(
    ("machine", "width", "expected"),
    [
        ("x86_64", "", ["-march=native"]),
        ("x86_64", "2", ["-march=native", "-DLANES=2", "-mno-avx512f"]),
        ("x86_64", "4", ["-march=native", "-DLANES=4", "-mno-avx512f"]),
        ("x86_64", "8", ["-march=native", "-DLANES=8"]),
        ("aarch64", "", ["-mcpu=native"]),
        ("arm64", "2", ["-mcpu=native", "-DLANES=2"]),
    ],
)
def test_flags_are_those_of_processor_and_width(
    machine: str, width: str, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Narrow vectors of x86 use no AVX-512, whose contraction would give other bits than processors without it."""
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setenv("PAYLOAD_TRANSPORT_NATIVE", width)
    assert list(compiler.processor_flags()) == expected


CPUINFO = """processor\t: 0
model name\t: first of its kind
cpu MHz\t\t: 1000
flags\t\t: fma avx2

processor\t: 1
model name\t: first of its kind
flags\t\t: fma avx2
"""


@pytest.mark.parametrize(
    ("old", "new", "is_another"),
    [
        ("first of its kind", "second of its kind", True),
        ("avx2", "avx512f", True),
        ("flags\t\t: fma avx2", "Features\t: asimd sve", True),
        ("1000", "2000", False),
        ("processor\t: 1", "processor\t: 2", False),
        ("\n\nprocessor\t: 1\nmodel name\t: first of its kind\nflags\t\t: fma avx2\n", "\n", False),
    ],
)
def test_a_processor_is_known_by_its_model_and_what_it_can(
    old: str, new: str, monkeypatch: pytest.MonkeyPatch, *, is_another: bool
) -> None:
    """Its present frequency and its number of cores make no other processor."""

    def identity(text: str | None) -> str:
        def read(*_: Any, **__: Any) -> str:
            if text is None:
                raise FileNotFoundError
            return text

        monkeypatch.setattr(Path, "read_text", read)
        return compiler._processor.__wrapped__()

    assert old in CPUINFO
    before, after = identity(CPUINFO), identity(CPUINFO.replace(old, new))
    arm = identity(CPUINFO.replace("flags\t\t: fma avx2", "Features\t: asimd"))
    monkeypatch.setattr(platform, "processor", lambda: "as Python has it")
    assert identity(None).endswith("as Python has it")
    monkeypatch.undo()
    assert (after != before) == is_another
    assert arm != after


def bits(built: dict[str, ca.Function], N: int) -> list[bytes]:
    """Every output of every function at a few random points."""
    rng = np.random.default_rng(N)
    found = []
    for _ in range(5):
        p = random_system(rng, N).vector()
        x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
        values: dict[str, Any] = {"i0": x, "i1": u, "i2": p, "i3": F, "i4": 0.05}
        short = {"i0": x, "i1": p}
        for function in built.values():
            given = short if function.n_in() == 2 else values
            arguments = [given[f"i{i}"] for i in range(function.n_in())]
            found += [array.tobytes() for array in Compiled(function)(*arguments)]
    return found


@pytest.mark.slow
@needs_compiler
def test_compiled_functions_give_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiled model gives the same bits as an interpreted one, so processes with and without it can run together."""
    monkeypatch.delenv("PAYLOAD_TRANSPORT_NATIVE", raising=False)
    with monkeypatch.context() as empty_cache:
        empty_cache.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path))
        interpreted = functions(3)
    assert {function.class_name() for function in interpreted.values()} == {
        "SXFunction",
        "MXFunction",
    }
    assert compile_functions(3)  # that of all tests
    compiled = functions(3)
    assert {function.class_name() for function in compiled.values()} == {"External"}
    assert list(compiled) == list(interpreted)
    assert bits(compiled, 3) == bits(interpreted, 3)


@needs_compiler
def test_functions_that_a_library_lacks_are_interpreted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that are too long to be compiled: all are there, with the same bits."""
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path))
    monkeypatch.delenv("PAYLOAD_TRANSPORT_NATIVE", raising=False)
    interpreted = functions(1)
    lengths = {name: function.n_instructions() for name, function in interpreted.items()}
    longest = sorted(lengths.values())[1]
    monkeypatch.setattr(casadi_functions, "_MAX_LENGTH", longest)
    assert compile_functions(1)
    partly = functions(1)
    compiled = {name for name, function in partly.items() if function.class_name() == "External"}
    assert compiled == {name for name, length in lengths.items() if length <= longest}
    assert 2 <= len(compiled) < len(interpreted)
    assert list(partly) == list(interpreted)
    assert bits(partly, 1) == bits(interpreted, 1)


@pytest.mark.slow
@needs_compiler
def test_a_rollout_in_one_call_is_one_in_steps() -> None:
    """States and inputs under a control law are those of the model's steps, with forces and at the bounds."""
    assert compile_functions(3)  # that of all tests
    rng, model, hover_u = np.random.default_rng(7), Model(ring(3)), hover(ring(3)).u
    x0, at_x0 = hover(ring(3)).x, hover_u + rng.normal(0.0, 0.5, (6, 12))
    forces = rng.normal(0.0, 1.0, 12)
    gains = rng.normal(0.0, 0.1, (len(at_x0), 12, 48))
    lower, upper = hover_u - 0.6, hover_u + 0.6
    upper[-4:] = np.inf  # of inputs without limits
    lower[-4:] = -np.inf
    for K in (gains[0], gains):  # the same at each step, or one for each
        feedback = Feedback(at_x=at_x0, K=K, lower=lower, upper=upper)
        rollout = model.rollout(x0, feedback, 0.05, forces)
        assert rollout is not None
        Z, U = rollout
        step, x = model.stepper(0.05, forces), x0
        for k, wanted in enumerate(at_x0):
            gain = K if K.ndim == 2 else K[k]
            u = np.clip(wanted + gain @ (x - x0), lower, upper)
            x = step(x, u)
            np.testing.assert_allclose(U[k], u, rtol=1e-12)
            np.testing.assert_allclose(Z[k + 1], x, rtol=1e-12, atol=1e-12)
        assert (upper[:4] == U[:, :4]).any()
        assert (np.abs(U[:, 8:] - hover_u[8:]) > 0.6).any()
    A, W = rng.normal(0.0, 0.1, (36, 36)), rng.normal(size=(6, 36))
    response = np.empty((7, 36))
    native.KERNELS.free_response(6, 36, *map(native.address, (A, W, response)))
    np.testing.assert_allclose(response, free_response(A, W), rtol=1e-12, atol=1e-12)


def test_addresses_follow_their_arrays() -> None:
    """An array keeps its address, another one has its own, and copies have the numbers of the newest."""
    addresses = native.Addresses()
    first, second = np.arange(3.0), np.arange(3.0)
    begin = addresses.of("x", first)
    assert begin == native.address(first) == addresses.of("x", first)
    assert addresses.address_of("x", first) == begin
    assert addresses.address_of("x", second) is None
    assert addresses.of("x", second) == native.address(second)
    assert addresses.array("x") is second

    integers: Any = np.arange(3)
    place = addresses.copied("y", integers)  # they become floats
    assert addresses.copied("y", np.array([0.5, 1.5, 2.5])) == place
    kept = addresses.array("y")
    assert kept is not None
    assert kept.tolist() == [0.5, 1.5, 2.5]
    addresses.copied("y", np.arange(4.0)[::2])  # another shape, and no row-major one
    kept = addresses.array("y")
    assert kept is not None
    assert kept.tolist() == [0.0, 2.0]


@pytest.mark.parametrize(
    "array",
    [np.zeros(3, dtype=np.float32), np.zeros(6)[::2], np.zeros((2, 3)).T, np.zeros(3, dtype=bool)],
    ids=["single precision", "every second one", "by column", "truth values"],
)
def test_an_array_that_a_kernel_cannot_read_is_refused(array: Any) -> None:
    """Only numbers of double precision and indices, one row after the other; read-only ones too, and empty ones."""
    for each in (array, frozen_copy(array)):
        with pytest.raises(
            TypeError, match="expected a row-major array of float64 or indices, got"
        ):
            native.address(each)
    fine = np.arange(6.0).reshape(2, 3)
    begin = native.address(fine)
    fine.setflags(write=False)
    assert native.address(fine) == begin == fine.ctypes.data
    assert native.address(np.zeros((0, 3))) == 0


def test_a_work_space_is_aligned_and_kept() -> None:
    """All calls of a kernel of one size share one, which has room for that size from the begin of a vector on."""
    spaces = {}
    for kernel in ("one of the test", "another"):
        for size in (*range(1, 10), 100):
            begin = native.work(kernel, size)
            assert begin % 64 == 0
            assert native.work(kernel, size) == begin
            memory = native._WORK_SPACES[kernel, size]._memory
            assert native.address(memory) <= begin
            assert begin + 8 * size <= native.address(memory) + memory.nbytes
            spaces[kernel, size] = begin
    assert len(set(spaces.values())) == len(spaces)


def frozen_copy(array: Any) -> Any:
    """Return a view of an array that cannot be written."""
    view = array.view()
    view.setflags(write=False)
    return view


@needs_compiler
def test_copies_of_a_linearisation_are_their_own() -> None:
    """A copy is not computed from the numbers of its original."""
    model, at = Model(ring(2)), hover(ring(2))
    original = model.linearise(at.x, at.u)
    expected = zero_order_hold(original, 0.05).A
    copied = deepcopy(original)
    original.jacobians.values[:] = 0.0
    np.testing.assert_array_equal(zero_order_hold(copied, 0.05).A, expected)


def test_gains_of_too_few_steps_are_refused() -> None:
    """A kernel does not read behind the gains."""
    with pytest.raises(ShapeError, match="of 4 steps"):
        Feedback(
            at_x=np.zeros((4, 8)), K=np.zeros((3, 8, 36)), lower=np.zeros(8), upper=np.zeros(8)
        )


@pytest.mark.parametrize(
    "environment",
    [
        {"PAYLOAD_TRANSPORT_NATIVE": "0"},
        {"PATH": "/nowhere", "CC": ""},
        {"PATH": "/nowhere", "CC": "/bin/false"},
    ],
)
def test_everything_works_without_a_compiler(environment: dict[str, str], tmp_path: Path) -> None:
    """Switched off, not there, or failing.

    The twins in Python do the work, and nothing is left in the cache.
    """
    code = (
        "from transport.model.kernels import native;"
        "from transport.model.kernels.casadi_functions import compile_functions, functions;"
        "print(native.AVAILABLE, compile_functions(1), functions(1)['derivative'].class_name());"
        "print(native.description())"
    )
    output = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PAYLOAD_TRANSPORT_CACHE": str(tmp_path), **environment},
        capture_output=True, check=True, text=True,
    )  # fmt: skip
    assert output.stdout.split() == ["False", "False", "SXFunction", "plain"]
    assert not list(tmp_path.glob("*.so"))


@needs_compiler
def test_a_library_of_another_user_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a cache folder that others can write to, only what the user or root put there counts."""
    library = tmp_path / "library.so"
    assert compiler.compile_library(library, [b"int one(void) { return 1; }"], ())
    assert compiler.intact(library)
    monkeypatch.setattr(os, "getuid", lambda: library.stat().st_uid + 1)
    if library.stat().st_uid != 0:
        assert not compiler.intact(library)
    else:
        assert compiler.intact(library), "root put it there"
        os.chown(library, 12345, -1)
        assert not compiler.intact(library)


@needs_kernels
def test_a_library_that_does_not_load_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that the system refuses, as for a folder without rights to execute: the plain kernels are used."""

    def refuse(_: str) -> None:
        raise OSError("failed to map segment from shared object")

    assert native.load() is not None
    monkeypatch.setattr(ctypes, "PyDLL", refuse)
    assert native.load() is None


@needs_compiler
@pytest.mark.parametrize("kept", [0, 1000], ids=["emptied", "cut"])
def test_a_damaged_library_is_compiled_again(kept: int, tmp_path: Path) -> None:
    """A library that a full disk emptied or cut is not loaded but rebuilt, with the same content."""
    library = tmp_path / "library.so"
    source = b"int one(void) { return 1; }"
    assert compiler.compile_library(library, [source], ())
    whole = library.read_bytes()
    library.write_bytes(whole[:kept])
    assert not compiler.intact(library)
    assert compiler.compile_library(library, [source], ())
    assert compiler.intact(library)
    assert len(library.read_bytes()) == len(whole)


@needs_compiler
def test_a_cache_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    """Without a place for libraries the plain kernels are used, and a warning names the folder."""
    no_folder = tmp_path / "file"
    no_folder.write_text("", encoding="utf-8")
    with pytest.warns(RuntimeWarning, match="plain ones are used") as warned:
        assert not compiler.compile_library(no_folder / "library.so", [b"int one;"], ())
    assert str(no_folder) in str(warned[0].message)


def test_a_compiler_that_cannot_be_started_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The warning names the compiler, not the folder, which is fine."""
    no_program = tmp_path / "cc"
    no_program.write_text("no program", encoding="utf-8")
    no_program.chmod(0o700)
    monkeypatch.setenv("CC", str(no_program))
    with pytest.warns(RuntimeWarning, match="the compiler .*cc cannot be started"):
        assert not compiler.compile_library(tmp_path / "cache" / "library.so", [b"int one;"], ())


@pytest.mark.parametrize("is_writable", [True, False])
def test_a_home_that_cannot_be_written_has_no_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, is_writable: bool
) -> None:
    """A container sets the home of an unknown user to a folder of root: the cache is temporary then."""
    for name in ("PAYLOAD_TRANSPORT_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda *_: is_writable)
    folder = compiler.cache_folder()
    assert folder.is_relative_to(tmp_path / ".cache") == is_writable
    assert str(os.getuid()) in folder.name or is_writable


def test_a_library_is_that_of_its_source_flags_and_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another source, other flags or another processor have another file: none loads code made for the other."""
    files = [
        compiler.compiled_file("one", b"source", ("-O3",)),
        compiler.compiled_file("one", b"other", ("-O3",)),
        compiler.compiled_file("one", b"source", ("-O1",)),
    ]
    monkeypatch.setattr(compiler, "_processor", lambda: "another")
    files.append(compiler.compiled_file("one", b"source", ("-O3",)))
    assert len(set(files)) == len(files)


def test_compiled_models_follow_from_all_code_of_the_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A change of any module whose code builds the functions gives another library."""
    read = set()

    class Reading(type(Path())):  # type: ignore[misc]
        """A path that tells what is read."""

        def read_bytes(self) -> bytes:
            read.add(str(self))
            return bytes(super().read_bytes())

    monkeypatch.setattr(casadi_functions, "Path", Reading)
    casadi_functions._digest.__wrapped__()

    used = set[str]()
    ahead: list[ModuleType] = [dynamics, outputs_and_sensors, projection_of_rods]
    while ahead:
        module = ahead.pop()
        used.add(module.__name__)
        for value in vars(module).values():
            is_module = isinstance(value, ModuleType)
            name = value.__name__ if is_module else getattr(value, "__module__", None)
            if str(name).startswith("transport.model.") and name not in used:
                ahead.append(sys.modules[str(name)])
    assert {sys.modules[name].__file__ for name in used} <= read
    assert casadi_functions.__file__ in read


def test_the_folder_named_for_the_cache_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then that of the desktop for all programs, in which the project has one of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "all"))
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path / "own"))
    assert compiler.cache_folder() == tmp_path / "own"
    monkeypatch.delenv("PAYLOAD_TRANSPORT_CACHE")
    assert compiler.cache_folder() == tmp_path / "all" / "payload-transport"


def test_the_compiler_of_the_environment_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CC names the compiler, also beside the usual ones."""
    own = tmp_path / "own-cc"
    own.write_text("", encoding="utf-8")
    own.chmod(0o700)
    monkeypatch.setenv("CC", str(own))
    assert compiler.find_compiler() == str(own)
