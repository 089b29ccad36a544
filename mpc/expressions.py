"""The user's constraints and cost terms as text: "r0[2] <= -2", "norm(r1 - r3) >= 0.8", "thrust1 <= 30"; "e1[0]".

Allowed are numbers, pi, arithmetic, norm, dot, cross, sin, cos, tan, sqrt, exp, fabs, fmin, fmax and
states: r0, v0, Theta0, omega0 of the payload, and of UAV i ri, ei, Omegai, Thetai, omegai; or
inputs: thrusti and taui, with commanded body rates thrusti and ratei.
"""

import ast
import operator
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from model import state
from model.arrays import Array
from model.compiled import Compiled
from model.dynamics import Symbols, uav_positions
from model.parameters import System
from mpc.settings import Constraint, CostTerm, SettingsError

_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
# Added under the root of a norm: the slope at zero is then zero instead of undefined, the value off by 1e-9.
_NORM_FLOOR = 1e-18
_CASADI_FUNCTIONS = ("dot", "cross", "sin", "cos", "tan", "sqrt", "exp", "fabs", "fmin", "fmax")
_FUNCTIONS: dict[str, Callable[..., Any]] = {name: getattr(ca, name) for name in _CASADI_FUNCTIONS}
_FUNCTIONS["norm"] = lambda a: ca.sqrt(ca.sumsqr(a) + _NORM_FLOOR)


class Relation(NamedTuple):
    """One constraint as an expression that must be <= 0 or = 0."""

    value: ca.SX  # scalar expression over the symbols it was read with
    on: Literal["state", "input"]  # never both, as in paper (18)-(19)
    is_equality: bool


def read(text: str, symbols: Symbols) -> Relation:
    """Read a constraint: two sides and one of <=, >=, ==. Raises: SettingsError: not readable, or mixed."""
    what = f"constraint {text!r}"
    match _parsed(text, what):
        case ast.Compare(left=left, ops=[ast.LtE() | ast.GtE() | ast.Eq() as comparison], comparators=[right]):
            sides = (right, left) if isinstance(comparison, ast.GtE) else (left, right)
        case _:
            raise SettingsError(f"{what}: expected two sides and one of <=, >=, ==")
    value = _scalar(ast.BinOp(sides[0], ast.Sub(), sides[1]), symbols, what)
    on_state, on_input = bool(ca.depends_on(value, symbols.x)), bool(ca.depends_on(value, symbols.u))
    if on_state == on_input:
        raise SettingsError(f"{what}: expected states or inputs, got {'both' if on_state else 'neither'}")
    return Relation(value, "state" if on_state else "input", isinstance(comparison, ast.Eq))


def read_term(text: str, symbols: Symbols) -> ca.SX:
    """Read a cost term, a scalar expression of states alone. Raises: SettingsError: not readable, or another."""
    what = f"cost {text!r}"
    value = _scalar(_parsed(text, what), symbols, what)
    if ca.depends_on(value, symbols.u) or not ca.depends_on(value, symbols.x):
        raise SettingsError(f"{what}: expected states alone; weights of inputs are controller.weights")
    return value


class Expressions:
    """The user's scalar expressions of a variable, state or input, and of parameters, whose values are p."""

    def __init__(self, values: Sequence[ca.SX], variable: ca.SX, parameters: ca.SX, p: Array) -> None:
        value = ca.vertcat(ca.SX(0, 1), *values)
        slope = ca.jacobian(value, variable)
        self._p, self._shape = p, slope.shape
        # Which elements of the variable occur in each expression, (c, n) or (c, m).
        self.depends = np.array(ca.DM(slope.sparsity(), 1).full(), dtype=bool)
        results = [ca.densify(value), ca.densify(slope)]
        self._function = Compiled(ca.Function("expressions", [variable, parameters], results)) if values else None

    def __len__(self) -> int:
        return int(self._shape[0])

    def at(self, point: Array) -> tuple[Array, Array]:
        """Return values, (c,), and gradients, (c, n) or (c, m), at a point: docs/equations.md (30), (48)."""
        if self._function is None:
            return np.zeros(0), np.zeros(self._shape)
        value, slope = self._function(point, self._p)
        return value, slope.reshape(self._shape)


class UserCosts(Expressions):
    """Weighted squares of the user's expressions of the state. Raises: SettingsError: one cannot be read."""

    def __init__(self, terms: Sequence[CostTerm], system: System) -> None:
        symbols = Symbols.of(system.N, system.commands_rates)
        values = [read_term(term.expression, symbols) for term in terms]
        super().__init__(values, symbols.x, symbols.p, system.vector())
        self._terms = tuple(terms)
        self.weights = np.array([term.weight for term in terms])  # of each term, per square of its unit, (t,)

    def about(self, x: Array) -> Array:
        """Return the roots of the weights times the gradients, (t, n). Raises: SettingsError: one is not finite."""
        values, slopes = self.at(x)
        for term, value, slope in zip(self._terms, values, slopes, strict=True):
            if not np.isfinite([value, *slope]).all():
                expected = "expected a finite value and slope at hover"
                raise SettingsError(f"cost {term.expression!r}: {expected}, got {value}")
        return np.asarray(np.sqrt(self.weights)[:, None] * slopes)


class UserConstraints(Expressions):
    """The user's constraints on states or on inputs, in the order given: at most zero, or zero."""

    def __init__(self, constraints: Sequence[Constraint], system: System, on: str, penalty: float = 1.0) -> None:
        symbols = Symbols.of(system.N, system.commands_rates)
        read_all = [(constraint, read(constraint.expression, symbols)) for constraint in constraints]
        chosen = [(constraint, relation) for constraint, relation in read_all if relation.on == on]
        variable = symbols.x if on == "state" else symbols.u
        super().__init__([relation.value for _, relation in chosen], variable, symbols.p, system.vector())
        self.equality = np.array([relation.is_equality for _, relation in chosen], dtype=bool)  # (c,)
        # Weight of the slack of a soft constraint, nan for a hard one, (c,).
        given = [penalty if constraint.penalty is None else constraint.penalty for constraint, _ in chosen]
        is_soft = np.array([constraint.soft for constraint, _ in chosen], dtype=bool)
        self.penalty = np.where(~is_soft | self.equality | (on == "input"), np.nan, given)


def compile_constraints(
    constraints: Sequence[Constraint], system: System, penalty: float = 1.0
) -> tuple[UserConstraints, UserConstraints]:
    """Read the user's constraints on states and on inputs, with the penalty of those without one.

    Raises: SettingsError: one cannot be read.
    """
    return UserConstraints(constraints, system, "state", penalty), UserConstraints(constraints, system, "input")


def _parsed(text: str, what: str) -> ast.expr:
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise SettingsError(f"{what}: cannot be read ({error})") from error


def _scalar(tree: ast.expr, symbols: Symbols, what: str) -> ca.SX:
    try:
        value = ca.SX(_evaluate(tree, _names(symbols), what))
    except (RuntimeError, TypeError, IndexError, ArithmeticError, NotImplementedError, RecursionError) as error:
        detail = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
        raise SettingsError(f"{what}: cannot be evaluated ({detail})") from error
    if value.shape != (1, 1):
        raise SettingsError(f"{what}: expected a scalar, got shape {value.shape}")
    return value


@lru_cache(maxsize=1)  # the texts of a scenario are read one after the other
def _names(symbols: Symbols) -> dict[str, Any]:
    x, u = symbols.x, symbols.u
    names = {"r0": x[state.R0], "v0": x[state.V0], "Theta0": x[state.THETA0], "omega0": x[state.OMEGA0], "pi": ca.pi}
    for i, position in enumerate(uav_positions(symbols)):
        block, inputs = x[state.uav_slice(i)], u[state.input_slice(i)]
        names |= {
            f"r{i + 1}": position,
            f"e{i + 1}": block[state.E],
            f"Omega{i + 1}": block[state.ROD_RATE],
            f"Theta{i + 1}": block[state.THETA],
            f"omega{i + 1}": block[state.OMEGA],
            f"thrust{i + 1}": inputs[0],
            f"{'rate' if symbols.rates else 'tau'}{i + 1}": inputs[1:],
        }
    return names


def _evaluate(node: ast.AST, names: dict[str, Any], what: str) -> Any:
    value = _value(node, names, what)
    if not isinstance(value, ca.SX) and not np.isfinite(np.asarray(value, dtype=np.float64)).all():
        raise SettingsError(f"{what}: {ast.unparse(node)!r} is not a finite number")
    return value


def _value(node: ast.AST, names: dict[str, Any], what: str) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return number
        case ast.Name(id=name):
            if name not in names:
                raise SettingsError(f"{what}: unknown name {name!r}; known: {', '.join(sorted(names))}")
            return names[name]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_evaluate(operand, names, what))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_evaluate(left, names, what), _evaluate(right, names, what))
        case ast.Subscript(value=value, slice=ast.Constant(value=int() as index)) if not isinstance(index, bool):
            return _evaluate(value, names, what)[index]
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](*[_evaluate(argument, names, what) for argument in arguments])
    raise SettingsError(f"{what}: {ast.unparse(node)!r} is not allowed; see mpc/expressions.py")
