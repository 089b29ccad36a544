"""The CasADi functions of the model, compiled and kept on disk, called through buffers."""

import hashlib
import itertools
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels import compiler
from transport.model.physics import (
    dynamics,
    outputs_and_sensors,
    projection_of_rods,
    rotations,
    symbols,
)
from transport.model.physics.parameters import Kind
from transport.model.physics.symbols import Symbols

# How `step` and `advance` are compiled: each is a tenth of the code, but they are evaluated most, tens of
# times in a step of a controller. GCC's vectorisation of straight code fuses products and sums of
# neighbours in spite of `-ffp-contract=off`.
_STEPS = ("step", "advance")
_OPTIMISED = """#pragma GCC push_options
#pragma GCC optimize("O3,no-tree-slp-vectorize")
{}
#pragma GCC pop_options"""
# Instructions; longer functions stay interpreted, as compilation time grows more than linearly.
_MAX_LENGTH = 80_000

_FUNCTIONS = (
    "derivative",
    "tensions",
    "velocities",
    "outputs",
    "linearise",
    *_STEPS,
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
        inputs = range(function.n_in())
        outputs = range(function.n_out())
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [np.zeros(function.numel_in(i)) for i in inputs]

        # Places of the outputs in the array that `flat` returns.
        ends = np.cumsum([0, *(function.nnz_out(i) for i in outputs)]).tolist()
        self.parts = [slice(begin, end) for begin, end in itertools.pairwise(ends)]
        self._results = np.zeros(ends[-1])

        # Matrices, as opposed to vectors and the nonzero entries of sparse outputs; CasADi is
        # column-major.
        self._matrices = []
        for i in outputs:
            if function.sparsity_out(i).is_dense() and function.size2_out(i) != 1:
                self._matrices.append((i, function.size_out(i)))

        for i, argument in enumerate(self._arguments):
            # The generated annotation is wrong, as that of set_res.
            self._buffer.set_arg(i, argument.data)  # type: ignore[call-arg]
        for i, part in enumerate(self.parts):
            self._buffer.set_res(i, self._results[part].data)  # type: ignore[call-arg]

    def __call__(self, *arguments: Array | float) -> list[Array]:
        """Return one new array per output.

        Vectors for single columns, the nonzero entries of sparse ones by column.
        """
        flat = self.flat(*arguments)
        outputs = [flat[part] for part in self.parts]
        for i, shape in self._matrices:
            outputs[i] = outputs[i].reshape(shape, order="F")
        return outputs

    def flat(self, *arguments: Array | float) -> Array:
        """Return the entries of all outputs in one new array; `parts` are their places."""
        for own, argument in zip(self._arguments, arguments, strict=True):
            own[:] = argument
        self._evaluate()
        return self._results.copy()


def functions(N: int, rates: bool = False, drag: bool = False) -> dict[str, ca.Function]:
    """Return the CasADi functions of N UAVs, with thrust and moments or body rates, and with drag.

    Compiled if on disk.

    derivative, tensions, sensed (x, u, p, F): x', the rod tensions, the UAVs' measurements
    velocities, outputs (x, p): velocities of the centres of mass, y
    linearise (x, u, p, F): x', y, and, sparse and transposed, the factors of `model.kernels.sparse_pattern`
    step (x, u, p, F, h): x after h seconds of constant u and F by one Dormand-Prince step and
        projection of the rods, and the local error estimate before projection
    advance (x, u, p, F, h): the first of these alone, which needs one evaluation of f less
    sense (x, u, p, F): measurements y of the UAVs' own sensors, and their derivatives in parts:
        those by (x, F) with the payload's acceleration held, sparse, by that acceleration, and its
        own by (x, F)
    """
    return _loaded(Kind(N, rates, drag), library(N, rates, drag))


@lru_cache(maxsize=8)
def _loaded(kind: Kind, path: Path | None) -> dict[str, ca.Function]:
    """Return the functions in a library, and those that it lacks as built by CasADi."""
    compiled: dict[str, ca.Function] = {}
    if path is not None:
        importer = ca.Importer(str(path), "dll")
        for name in _FUNCTIONS:
            if importer.has_function(name):
                compiled[name] = ca.external(name, importer)

    if len(compiled) == len(_FUNCTIONS):
        return compiled
    return _build(*kind) | compiled


def needs_compilation(N: int, rates: bool = False, drag: bool = False) -> bool:
    """Return whether `compile_functions` would compile.

    A compiler is there, and the functions are not compiled yet.
    """
    return (
        compiler.enabled()
        and compiler.find_compiler() is not None
        and library(N, rates, drag) is None
    )


def compile_functions(N: int, rates: bool = False, drag: bool = False) -> bool:
    """Compile the functions of N UAVs, with the same bits, for this processor, in seconds.

    Return whether they are.
    """
    if needs_compilation(N, rates, drag):
        sources = []
        for name, function in functions(N, rates, drag).items():
            if function.n_instructions() > _MAX_LENGTH:
                continue
            source = _source(function)
            optimised = _OPTIMISED.format(source) if name in _STEPS else source
            sources.append(optimised.encode())
        compiler.compile_library(_file(N, rates, drag), sources, _flags())
    return library(N, rates, drag) is not None


def library(N: int, rates: bool, drag: bool = False) -> Path | None:
    """Return the file of the compiled functions of a system of N UAVs; None if there is none."""
    path = _file(N, rates, drag)
    return path if compiler.enabled() and compiler.intact(path) else None


def _file(N: int, rates: bool, drag: bool) -> Path:
    """Return the path of the library of a system of N UAVs."""
    inputs = "rates-" if rates else ""
    air = "drag-" if drag else ""
    return compiler.compiled_file(f"model-{inputs}{air}N{N}", _digest(), _flags())


@lru_cache
def _flags() -> tuple[str, ...]:
    """Return the compiler's flags, as this process first finds the environment."""
    return (*compiler.GENERATED_FLAGS, *compiler.processor_flags())


@lru_cache
def _digest() -> bytes:
    """Return a hash of all code that determines the functions, as this process first finds it."""
    modules = dynamics, outputs_and_sensors, projection_of_rods, rotations, symbols, state
    files = [__file__, *(module.__file__ for module in modules)]
    sources = [Path(str(file)).read_bytes() for file in files]
    return hashlib.sha256(b"".join([ca.CasadiMeta.version().encode(), *sources])).digest()


def _source(function: ca.Function) -> str:
    """Return a function in C.

    The generator's name prefixes its helpers.
    """
    generator = ca.CodeGenerator(f"{function.name()}_source.c", {"with_header": False})
    generator.add(function)
    return str(generator.dump())


def _build(N: int, rates: bool, drag: bool) -> dict[str, ca.Function]:
    """Return all functions of N UAVs as CasADi evaluates them."""
    s = Symbols.of(N, rates, drag)
    arguments = [s.x, s.u, s.p, s.F]
    motion = dynamics.motion(s)
    y = outputs_and_sensors.outputs(s)
    derivative = ca.Function("derivative", arguments, [motion.derivative])
    sense = _sense(s, motion)
    # Inlined, so that the derivatives are left out; the first output is the measurements.
    sensed = sense.call(arguments, True, False)[:1]
    return {
        "derivative": derivative,
        "tensions": ca.Function("tensions", arguments, [motion.tensions]),
        "velocities": ca.Function("velocities", [s.x, s.p], [outputs_and_sensors.velocities(s)]),
        "outputs": ca.Function("outputs", [s.x, s.p], [y]),
        "linearise": _linearise(s, motion, y),
        **_steps(s, derivative),
        "sense": sense,
        "sensed": ca.Function("sensed", arguments, sensed),
    }


def _sense(s: Symbols, motion: dynamics.Motion) -> ca.Function:
    """Return the measurements and their derivatives by (x, F): (61).

    The payload's acceleration a is held as in `_linearise`: dy = dy/d(x, F) + dy/da da/d(x, F).
    """
    a = ca.SX.sym("a", 6)
    wrt = ca.vertcat(s.x, s.F)
    given = dynamics.motion(s, a)
    y = outputs_and_sensors.sensed(s, given.tensions)

    # da/d(x, F) = M^-1 d(b - M a)/d(x, F), a held.
    unbalanced = ca.jacobian(given.unbalanced, wrt)
    a_wrt = dynamics.solve_positive_definite(motion.mass, unbalanced)

    parts = [y, ca.jacobian(y, wrt), ca.jacobian(y, a), a_wrt]
    y, y_wrt, y_a, a_wrt = ca.substitute(parts, [a], [motion.acceleration])
    results = [ca.densify(y), y_wrt, ca.densify(y_a), ca.densify(a_wrt)]
    return ca.Function("sense", [s.x, s.u, s.p, s.F], results)


def _linearise(s: Symbols, motion: dynamics.Motion, y: ca.SX) -> ca.Function:
    """Return x', y, the factors of `model.linear.linearisation.Jacobians`, and C: (15)-(15b).

    Factors are transposed, so that their entries follow row by row.
    """
    C = ca.jacobian(y, s.x)
    transposed = [ca.sparsify(factor).T for factor in [*_factors(s, motion), C]]
    results = [ca.densify(motion.derivative), ca.densify(y), *transposed]
    return ca.Function("linearise", [s.x, s.u, s.p, s.F], results)


def _factors(s: Symbols, motion: dynamics.Motion) -> list[ca.SX]:
    """Return X, U, P, V_x and V_u of A_c = X + P V_x, B_c = U + P V_u: (15b).

    g(x, u, a) is the derivative under a given acceleration a of the payload, which solves M a = b.
    """
    a = ca.SX.sym("a", 6)
    Pi = projection_of_rods.projection(s.x, s.N)
    given = dynamics.motion(s, a)
    g = given.derivative

    # [V_x, V_u] = M^-1 d(b - M a)/d(x, u), a held.
    by_state = ca.jacobian(given.unbalanced, s.x) @ Pi
    by_input = ca.jacobian(given.unbalanced, s.u)
    V = dynamics.solve_positive_definite(motion.mass, ca.horzcat(by_state, by_input))
    n = s.x.numel()
    V_x = V[:, :n]
    V_u = V[:, n:]

    X = ca.jacobian(g, s.x) @ Pi
    U = ca.jacobian(g, s.u)
    P = ca.jacobian(g, a)
    factors: list[ca.SX] = ca.substitute([X, U, P, V_x, V_u], [a], [motion.acceleration])
    return factors


def _steps(s: Symbols, f: ca.Function) -> dict[str, ca.Function]:
    """Return one Dormand-Prince step, with its error and without: (13a), (13b).

    The derivative is called, not repeated, so that the code stays short.
    """
    x = ca.MX.sym("x", s.x.numel())
    u = ca.MX.sym("u", s.u.numel())
    p = ca.MX.sym("p", s.p.numel())
    F = ca.MX.sym("F", s.F.numel())
    h = ca.MX.sym("h")

    # x'_j = f(x + h sum_l a_jl x'_l, u)
    slopes: list[ca.MX] = []
    for coefficients in _DP_STAGES:
        slopes.append(f(x + _weighted(h, coefficients, slopes), u, p, F))

    # x+ = x + h sum_j b_j x'_j,  error = h sum_j (b_j - b_j^(4)) x'_j
    fifth = x + _weighted(h, _DP_FIFTH, slopes)
    differences = [b5 - b4 for b5, b4 in zip(_DP_FIFTH, _DP_FOURTH, strict=True)]
    error = _weighted(h, differences, slopes)

    project = ca.Function("project", [s.x], [projection_of_rods.project(s.x, s.N)])
    arguments = [x, u, p, F, h]
    return {
        "step": ca.Function("step", arguments, [project(fifth), error]),
        "advance": ca.Function("advance", arguments, [project(fifth)]),
    }


def _weighted(h: ca.MX, coefficients: Sequence[float], slopes: Sequence[ca.MX]) -> ca.MX:
    """Return h times the weighted sum of slopes; weights of zero are left out."""
    terms = [b * slope for b, slope in zip(coefficients, slopes, strict=True) if b]
    if not terms:
        return ca.MX(0)
    return h * sum(terms[1:], start=terms[0])
