"""Compiled model functions: built once per number of UAVs, kept on disk, called through CasADi's buffers.

Building the Jacobians symbolically takes a second for large N, and every process of a run needs the same ones. They
depend on N alone (physical parameters are arguments), so the next process loads them from the cache in milliseconds.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np

from model import compiler, dynamics, rotations, state
from model.arrays import Array, ShapeError
from model.cache import cache_folder, replace_atomically
from model.dynamics import Symbols

# No contraction of products and sums: the same bits as CasADi's interpreter.
_FLAGS = ("-Og", "-ffp-contract=off")
# Instructions; longer functions stay interpreted, as compilation time grows more than linearly.
_MAX_LENGTH = 40_000

_FUNCTIONS = ("derivative", "tensions", "velocities", "outputs", "linearise", "step")

# Coefficients of the Dormand-Prince 5(4) pair (J. Comput. Appl. Math. 6, 1980): stages, 5th order, 4th order.
_DP_STAGES: tuple[tuple[float, ...], ...] = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_DP_FIFTH = (*_DP_STAGES[6], 0.0)
_DP_FOURTH = (5179 / 57600, 0.0, 7571 / 16695, 393 / 640, -92097 / 339200, 187 / 2100, 1 / 40)


class Compiled:
    """A CasADi function behind preallocated buffers, arrays in, arrays out; inputs and outputs are dense."""

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._name: str = function.name()
        self._arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        # CasADi is column-major.
        self._results = [
            np.zeros(function.numel_out(i)).reshape(function.size_out(i), order="F") for i in range(function.n_out())
        ]
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, argument.data)  # type: ignore[call-arg]  # the generated annotation is wrong
        for i, result in enumerate(self._results):
            self._buffer.set_res(i, result.reshape(-1, order="A").data)  # type: ignore[call-arg]

    def __call__(self, *arguments: Array | float) -> list[Array]:
        """Return one new array per output from one array (or float) per input; matrices with one column become vectors.

        Raises: ShapeError: an argument of the wrong length.
        """
        for own, argument in zip(self._arguments, arguments, strict=True):
            if np.size(argument) != own.size:
                raise ShapeError(f"{self._name}: expected an argument of {own.size} numbers, got {np.size(argument)}")
            own[:] = argument
        self._evaluate()
        return [r[:, 0].copy() if r.shape[1] == 1 else r.copy(order="F") for r in self._results]


def functions(N: int) -> dict[str, ca.Function]:
    """Return the CasADi functions of a system of N UAVs, from the cache if it holds them.

    derivative  (x, u, p, F) -> x'
    tensions    (x, u, p, F) -> rod tensions
    velocities  (x, p) -> velocities of the centres of mass
    outputs     (x, p) -> y
    linearise   (x, u, p, F) -> x', df/dx, B_c, y, C
    step        (x, u, p, F, h) -> x after h seconds of constant u and F by one Dormand-Prince step and projection
                of the rods, and the local error estimate before projection
    """
    compiled = _compiled(N)
    if len(compiled) == len(_FUNCTIONS):
        return compiled
    path, missing = _cache_path(N), [name for name in _FUNCTIONS if name not in compiled]
    found = _read_cache(path, missing)
    if found is None:
        found = _build(N)
        _write_cache(path, found)
    return found | compiled


def compile_functions(N: int) -> bool:
    """Compile the functions of a system of N UAVs for this processor; return False if that is not possible.

    Later calls of `functions`, in all processes, return the compiled ones, with bit-identical results. Compilation
    takes seconds: call this before the processes of a run are started.
    """
    path = _compiled_file(N)
    if not compiler.enabled() or compiler.find_compiler() is None:
        return False
    if compiler.intact(path):
        return True
    sources = (_source(function) for function in functions(N).values() if function.n_instructions() <= _MAX_LENGTH)
    return compiler.compile_library(path, "\n".join(sources).encode(), _FLAGS)


def _source(function: ca.Function) -> str:
    """Return a function in C. The generator's name prefixes its helpers, so that sources can be concatenated."""
    generator = ca.CodeGenerator(f"{function.name()}_source.c", {"with_header": False})
    generator.add(function)
    text: str = generator.dump()
    return text


def _compiled(N: int) -> dict[str, ca.Function]:
    """Return the functions already compiled for this processor."""
    path = _compiled_file(N)
    if not compiler.enabled() or not compiler.intact(path):
        return {}
    library = ca.Importer(str(path), "dll")
    return {name: ca.external(name, library) for name in _FUNCTIONS if library.has_function(name)}


def _build(N: int) -> dict[str, ca.Function]:
    s = Symbols.of(N)
    derivative, tensions = dynamics.state_derivative(s)
    y = dynamics.outputs(s)
    f = ca.Function("derivative", [s.x, s.u, s.p, s.F], [derivative])

    h = ca.SX.sym("h")
    slopes: list[ca.SX] = []
    for coefficients in _DP_STAGES:
        at = s.x + h * sum((a * k for a, k in zip(coefficients, slopes, strict=True)), start=ca.SX.zeros(s.x.shape))
        slopes.append(f(at, s.u, s.p, s.F))
    fifth = s.x + h * sum((b * k for b, k in zip(_DP_FIFTH, slopes, strict=True)), start=ca.SX.zeros(s.x.shape))
    error = h * sum(
        ((b5 - b4) * k for b5, b4, k in zip(_DP_FIFTH, _DP_FOURTH, slopes, strict=True)), start=ca.SX.zeros(s.x.shape)
    )
    linearised = [derivative, ca.jacobian(derivative, s.x), ca.jacobian(derivative, s.u), y, ca.jacobian(y, s.x)]
    return {
        "derivative": f,
        "tensions": ca.Function("tensions", [s.x, s.u, s.p, s.F], [tensions]),
        "velocities": ca.Function("velocities", [s.x, s.p], [dynamics.velocities(s)]),
        "outputs": ca.Function("outputs", [s.x, s.p], [y]),
        "linearise": ca.Function("linearise", [s.x, s.u, s.p, s.F], [ca.densify(value) for value in linearised]),
        "step": ca.Function("step", [s.x, s.u, s.p, s.F, h], [dynamics.project(fifth, N), error]),
    }


def _cache_path(N: int) -> Path:
    return cache_folder() / f"model-N{N}-{_digest()[:16]}.casadi"


def _compiled_file(N: int) -> Path:
    return compiler.compiled_file(f"model-N{N}", _digest().encode(), (*_FLAGS, str(_MAX_LENGTH)))


def _digest() -> str:
    """Return a hash of all code that determines the functions."""
    sources: Sequence[str | None] = (__file__, dynamics.__file__, rotations.__file__, state.__file__)
    digest = hashlib.sha256(ca.CasadiMeta.version().encode())
    for source in sources:
        if source is not None:
            digest.update(Path(source).read_bytes())
    return digest.hexdigest()


def _read_cache(path: Path, names: Sequence[str]) -> dict[str, ca.Function] | None:
    """Return some of the functions; only these are held in memory, as those of large teams are large."""
    texts: dict[str, bytes] = {}
    digest, count = hashlib.sha256(), 0
    try:
        with path.open("rb") as file:
            checksum = file.readline().rstrip(b"\n")
            for count, line in enumerate(file, start=1):
                digest.update(line)
                if count <= len(_FUNCTIONS) and _FUNCTIONS[count - 1] in names:
                    texts[_FUNCTIONS[count - 1]] = line
    except OSError:
        return None
    if digest.hexdigest().encode() != checksum:
        return None  # truncated or damaged: CasADi could crash on it
    if count != len(_FUNCTIONS):
        return None  # written by a process whose source changed while it ran
    return {name: ca.Function.deserialize(texts.pop(name).decode("latin-1").rstrip("\n")) for name in names}


def _write_cache(path: Path, built: dict[str, ca.Function]) -> None:
    body = "\n".join(built[name].serialize() for name in _FUNCTIONS).encode("latin-1")
    checksum = hashlib.sha256(body).hexdigest().encode()
    replace_atomically(path, checksum + b"\n" + body)
