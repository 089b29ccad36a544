"""Model functions of a number of UAVs.

Built, or compiled and kept on disk, and called through CasADi's buffers.
"""

import hashlib
import itertools
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np

from transport.model import compiler, dynamics, rotations, state
from transport.model.arrays import Array
from transport.model.dynamics import Symbols

# No contraction of products and sums: the same bits as CasADi's interpreter.
_FLAGS = ("-Og", "-march=native", "-fno-math-errno", "-ffp-contract=off")
# A tenth of the code, evaluated tens of times in a step of a controller: worth the time of its
# compilation. GCC's vectorisation of straight code fuses products and sums of neighbours in spite
# of the flag above.
_OFTEN = '#pragma GCC push_options\n#pragma GCC optimize("O2,no-tree-slp-vectorize")\n{}\n#pragma GCC pop_options'
# Instructions; longer functions stay interpreted, as compilation time grows more than linearly.
_MAX_LENGTH = 80_000

_FUNCTIONS = (
    "derivative",
    "tensions",
    "velocities",
    "outputs",
    "linearise",
    "step",
    "sense",
    "sensed",
)

# Coefficients of the Dormand-Prince 5(4) pair (J. Comput. Appl. Math. 6, 1980): stages, 5th order,
# 4th order.
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
    """A CasADi function behind preallocated buffers, arrays in, arrays out; inputs are dense."""

    def __init__(self, function: ca.Function) -> None:
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        ends = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))]).tolist()
        self.parts = [
            slice(begin, end) for begin, end in itertools.pairwise(ends)
        ]  # of the outputs in that of `flat`
        # Matrices, as opposed to vectors and the nonzero entries of sparse outputs; CasADi is
        # column-major.
        self._matrices = [
            (i, function.size_out(i))
            for i in range(function.n_out())
            if function.sparsity_out(i).is_dense() and function.size2_out(i) != 1
        ]
        self._results = np.zeros(ends[-1])
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, argument.data)  # type: ignore[call-arg]  # the generated annotation is wrong
        for i, part in enumerate(self.parts):
            self._buffer.set_res(i, self._results[part].data)  # type: ignore[call-arg]

    def __call__(self, *arguments: Array | float) -> list[Array]:
        """Return one new array per output.

        Vectors for single columns, the nonzero entries of sparse ones by column.
        """
        flat = self.flat(*arguments)
        found = [flat[part] for part in self.parts]
        for i, shape in self._matrices:
            found[i] = found[i].reshape(shape, order="F")
        return found

    def flat(self, *arguments: Array | float) -> Array:
        """Return the entries of all outputs in one new array; `parts` are their places."""
        for own, argument in zip(self._arguments, arguments, strict=True):
            own[:] = argument
        self._evaluate()
        return self._results.copy()


def functions(N: int, rates: bool = False) -> dict[str, ca.Function]:
    """Return the CasADi functions of N UAVs, with thrust and moments or body rates as inputs.

    Compiled if on disk.

    derivative, tensions, sensed (x, u, p, F) and velocities, outputs (x, p) return what they say;
    further ones are linearise (x, u, p, F) -> x', y, and, sparse and transposed, the factors of
    `model.linearisation.Pattern` step (x, u, p, F, h) -> x after h seconds of constant u and F by
    one Dormand-Prince step and projection of the rods, and the local error estimate before
    projection sense (x, u, p, F) -> measurements y of the UAVs' own sensors, and their derivatives
    in parts: those by (x, F) with the payload's acceleration held, sparse, by that acceleration,
    and its own by (x, F)
    """
    return _loaded(N, rates, library(N, rates))


@lru_cache(maxsize=4)
def _loaded(N: int, rates: bool, path: Path | None) -> dict[str, ca.Function]:
    compiled: dict[str, ca.Function] = {}
    if path is not None:
        importer = ca.Importer(str(path), "dll")
        compiled = {
            name: ca.external(name, importer) for name in _FUNCTIONS if importer.has_function(name)
        }
    return compiled if len(compiled) == len(_FUNCTIONS) else _build(N, rates) | compiled


def needs_compilation(N: int, rates: bool = False) -> bool:
    """Return whether `compile_functions` would compile.

    A compiler is there, and the functions are not compiled yet.
    """
    return compiler.enabled() and compiler.find_compiler() is not None and library(N, rates) is None


def compile_functions(N: int, rates: bool = False) -> bool:
    """Compile the functions of N UAVs, with the same bits, for this processor, in seconds.

    Return whether they are.
    """
    if needs_compilation(N, rates):
        sources = [
            _OFTEN.format(_source(function)) if name == "step" else _source(function)
            for name, function in functions(N, rates).items()
            if function.n_instructions() <= _MAX_LENGTH
        ]
        compiler.compile_library(_file(N, rates), "\n".join(sources).encode(), _FLAGS)
    return library(N, rates) is not None


def library(N: int, rates: bool) -> Path | None:
    """Return the file of the compiled functions of a system of N UAVs; None if there is none."""
    path = _file(N, rates)
    return path if compiler.enabled() and compiler.intact(path) else None


def _file(N: int, rates: bool) -> Path:
    return compiler.compiled_file(f"model-{'rates-' if rates else ''}N{N}", _digest(), _FLAGS)


@lru_cache
def _digest() -> bytes:
    """Return a hash of all code that determines the functions, as it is when this process first asks."""
    files = __file__, dynamics.__file__, rotations.__file__, state.__file__
    sources = [Path(str(file)).read_bytes() for file in files]
    return hashlib.sha256(b"".join([ca.CasadiMeta.version().encode(), *sources])).digest()


def _source(function: ca.Function) -> str:
    """Return a function in C.

    The generator's name prefixes its helpers, so that sources can be concatenated.
    """
    generator = ca.CodeGenerator(f"{function.name()}_source.c", {"with_header": False})
    generator.add(function)
    return str(generator.dump())


@lru_cache(maxsize=2)
def _build(N: int, rates: bool) -> dict[str, ca.Function]:
    s = Symbols.of(N, rates)
    motion = dynamics.motion(s)
    y = dynamics.outputs(s)
    sense = _sense(s, motion)
    f = ca.Function("derivative", [s.x, s.u, s.p, s.F], [motion.derivative])
    return {
        "derivative": f,
        "tensions": ca.Function("tensions", [s.x, s.u, s.p, s.F], [motion.tensions]),
        "velocities": ca.Function("velocities", [s.x, s.p], [dynamics.velocities(s)]),
        "outputs": ca.Function("outputs", [s.x, s.p], [y]),
        "linearise": _linearise(s, motion, y),
        "step": _step(s, f),
        "sense": sense,
        "sensed": ca.Function(
            "sensed", [s.x, s.u, s.p, s.F], sense.call([s.x, s.u, s.p, s.F], True, False)[:1]
        ),
    }


def _sense(s: Symbols, motion: dynamics.Motion) -> ca.Function:
    """Return the measurements, and as in `_linearise` their derivatives with a held, by a, and those of a."""
    a, wrt = ca.SX.sym("a", 6), ca.vertcat(s.x, s.F)
    given = dynamics.motion(s, a)
    y = dynamics.sensed(s, given.tensions)
    by_acceleration = dynamics.solve_positive_definite(
        motion.mass, ca.jacobian(given.unbalanced, wrt)
    )
    found = ca.substitute(
        [y, ca.jacobian(y, wrt), ca.jacobian(y, a), by_acceleration], [a], [motion.acceleration]
    )
    return ca.Function(
        "sense", [s.x, s.u, s.p, s.F], [ca.densify(found[0]), found[1], *map(ca.densify, found[2:])]
    )


def _linearise(s: Symbols, motion: dynamics.Motion, y: ca.SX) -> ca.Function:
    """Return the parts of `model.linearisation.Linearisation`.

    A solves M a = b, so a' is M^-1 (b - M a)', a held.
    """
    a, Pi = ca.SX.sym("a", 6), dynamics.projection(s.x, s.N)
    given = dynamics.motion(s, a)
    direct, pushed = (
        given.derivative,
        [ca.jacobian(given.unbalanced, s.x) @ Pi, ca.jacobian(given.unbalanced, s.u)],
    )
    by_acceleration = dynamics.solve_positive_definite(motion.mass, ca.horzcat(*pushed))
    parts = [ca.jacobian(direct, s.x) @ Pi, ca.jacobian(direct, s.u), ca.jacobian(direct, a)]
    parts += [by_acceleration[:, : s.x.numel()], by_acceleration[:, s.x.numel() :]]
    parts = [*ca.substitute(parts, [a], [motion.acceleration]), ca.jacobian(y, s.x)]
    # Transposed: row by row.
    found = [motion.derivative, y, *(ca.sparsify(part).T for part in parts)]
    return ca.Function(
        "linearise", [s.x, s.u, s.p, s.F], [ca.densify(found[0]), ca.densify(y), *found[2:]]
    )


def _step(s: Symbols, f: ca.Function) -> ca.Function:
    """Return one Dormand-Prince step.

    The derivative is called, not repeated, so that the code stays short.
    """
    x, u, p, F = (ca.MX.sym(name, getattr(s, name).numel()) for name in ("x", "u", "p", "F"))
    h, slopes = ca.MX.sym("h"), list[ca.MX]()
    for coefficients in _DP_STAGES:
        slopes.append(f(x + _weighted(h, coefficients, slopes), u, p, F))
    fifth = x + _weighted(h, _DP_FIFTH, slopes)
    error = _weighted(h, [b5 - b4 for b5, b4 in zip(_DP_FIFTH, _DP_FOURTH, strict=True)], slopes)
    project = ca.Function("project", [s.x], [dynamics.project(s.x, s.N)])
    return ca.Function("step", [x, u, p, F, h], [project(fifth), error])


def _weighted(h: ca.MX, coefficients: Sequence[float], slopes: Sequence[ca.MX]) -> ca.MX:
    terms = [b * slope for b, slope in zip(coefficients, slopes, strict=True) if b]
    return h * sum(terms[1:], start=terms[0]) if terms else ca.MX(0)
