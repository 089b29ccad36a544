"""The user's constraints and cost terms as text.

For example "r0[2] <= -2", "norm(r1 - r3) >= 0.8", "thrust1 <= 30"; "e1[0]".

Allowed are numbers, pi, arithmetic, norm, dot, cross, sin, cos, tan, sqrt, exp, fabs, fmin, fmax,
and states: r0, v0, Theta0, omega0 of the payload, and of UAV i ri, ei, Omegai, Thetai, omegai; or
inputs: thrusti and taui, with commanded body rates thrusti and ratei. All numbers are floats:
powers of integers could have millions of digits.
"""

import ast
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array, frozen
from transport.model.kernels.casadi_functions import Compiled
from transport.model.physics.outputs_and_sensors import uav_positions
from transport.model.physics.parameters import Kind, System
from transport.model.physics.symbols import Symbols
from transport.mpc.settings_period_horizon_weights import ConstraintSection, CostTerm, SettingsError

_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
# Added under the root of a norm: the slope at zero is then zero instead of undefined, the value off
# by 1e-9.
_NORM_FLOOR = 1e-18
_CASADI_FUNCTIONS = ("dot", "cross", "sin", "cos", "tan", "sqrt", "exp", "fabs", "fmin", "fmax")
_FUNCTIONS: dict[str, Callable[..., Any]] = {name: getattr(ca, name) for name in _CASADI_FUNCTIONS}
_FUNCTIONS["norm"] = lambda a: ca.sqrt(ca.sumsqr(a) + _NORM_FLOOR)
# Largest violation of a hard constraint at hover that counts as rounding.
_KEPT_WITHIN = 1e-6

# What an expression is of: x, (n,), or u, (m,).
Variable = Literal["state", "input"]

# Failures of arithmetic and of CasADi in a text that can be read.
_FAILURES = (
    RuntimeError,
    TypeError,
    IndexError,
    ArithmeticError,
    NotImplementedError,
    RecursionError,
)


class Relation(NamedTuple):
    """One constraint as an expression that must be <= 0 or = 0."""

    value: ca.SX  # scalar expression over the symbols it was read with
    on: Variable  # never both, as in paper (18)-(19)
    is_equality: bool


def read(text: str, symbols: Symbols) -> Relation:
    """Read a constraint: two sides and one of <=, >=, ==.

    Raises: SettingsError: not readable, or mixed.
    """
    label = f"constraint {text!r}"
    match _parsed(text, label):
        case ast.Compare(
            left=left, ops=[ast.LtE() | ast.GtE() | ast.Eq() as comparison], comparators=[right]
        ):
            sides = (right, left) if isinstance(comparison, ast.GtE) else (left, right)
        case _:
            raise SettingsError(f"{label}: expected two sides and one of <=, >=, ==")

    value = _scalar(ast.BinOp(sides[0], ast.Sub(), sides[1]), symbols, label)
    on_state = bool(ca.depends_on(value, symbols.x))
    on_input = bool(ca.depends_on(value, symbols.u))
    if on_state == on_input:
        got = "both" if on_state else "neither"
        raise SettingsError(f"{label}: expected states or inputs, got {got}")
    return Relation(value, "state" if on_state else "input", isinstance(comparison, ast.Eq))


def read_term(text: str, symbols: Symbols) -> ca.SX:
    """Read a cost term, a scalar expression of states alone.

    Raises: SettingsError: not readable, or another.
    """
    label = f"cost {text!r}"
    value = _scalar(_parsed(text, label), symbols, label)
    if ca.depends_on(value, symbols.u) or not ca.depends_on(value, symbols.x):
        expected = "expected states alone; weights of inputs are controller.weights"
        raise SettingsError(f"{label}: {expected}")
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Formulas:
    """Scalar expressions of a variable, state or input, and their gradients as a function."""

    # Values and gradients, from variable and parameters; None without any expression.
    function: ca.Function | None
    depends: npt.NDArray[np.bool_]  # which elements of the variable occur in each, (c, n) or (c, m)

    @staticmethod
    def of(values: Sequence[ca.SX], variable: ca.SX, parameters: ca.SX) -> "Formulas":
        """Return the formulas of expressions."""
        value = ca.vertcat(ca.SX(0, 1), *values)
        slope = ca.jacobian(value, variable)
        function = None
        if values:
            results = [ca.densify(value), ca.densify(slope)]
            function = ca.Function("expressions", [variable, parameters], results)
        depends = np.array(ca.DM(slope.sparsity(), 1).full(), dtype=bool)
        frozen(depends)
        return Formulas(function=function, depends=depends)


class Expressions:
    """Formulas of a variable, state or input, and of parameters, whose values are p."""

    def __init__(self, formulas: Formulas, p: Array) -> None:
        self._p = p
        self.depends = formulas.depends
        self._shape = formulas.depends.shape
        function = formulas.function
        self._function = None if function is None else Compiled(function)

    def __len__(self) -> int:
        return len(self.depends)

    def use(self, p: Array) -> None:
        """Take other values of the parameters."""
        self._p = p

    def at(self, point: Array) -> tuple[Array, Array]:
        """Return values, (c,), and gradients, (c, n) or (c, m), at a point.

        Source: docs/equations.md (30), (48).
        """
        if self._function is None:
            return np.zeros(0), np.zeros(self._shape)
        value, slope = self._function(point, self._p)
        return value, slope.reshape(self._shape)


@lru_cache(maxsize=64)  # all agents of a run, and most runs of a sweep, have the same terms
def _cost_formulas(texts: tuple[str, ...], kind: Kind) -> Formulas:
    """Return the formulas of cost terms. Raises: SettingsError: one cannot be read."""
    symbols = Symbols.of(*kind)
    values = [read_term(text, symbols) for text in texts]
    return Formulas.of(values, symbols.x, symbols.p)


# Place of a state, in messages.
ON_REFERENCE = "on the reference"


class UserCosts(Expressions):
    """Weighted squares of the user's expressions of the state.

    Raises: SettingsError: one cannot be read.
    """

    def __init__(self, terms: Sequence[CostTerm], system: System) -> None:
        texts = tuple(term.expression for term in terms)
        formulas = _cost_formulas(texts, system.kind)
        super().__init__(formulas, system.vector())
        self._terms = tuple(terms)
        # Weight of each term, per square of its unit, (t,).
        self.weights = np.array([term.weight for term in terms])

    def about(self, x: Array, place: str = "at hover") -> Array:
        """Return the roots of the weights times the gradients, (t, n).

        `place` says in words where x, (n,), is. Raises: SettingsError: one is not finite.
        """
        values, slopes = self.at(x)
        for term, value, slope in zip(self._terms, values, slopes, strict=True):
            _check_finite(f"cost {term.expression!r}", value, slope, place)
        return np.asarray(np.sqrt(self.weights)[:, None] * slopes)


class UserConstraints(Expressions):
    """The user's constraints on states or on inputs, in the order given: at most zero, or zero.

    Args:
        penalties: Defaults of soft ones: of rows on places, and of all others.
    """

    def __init__(
        self,
        constraints: Sequence[ConstraintSection],
        system: System,
        on: Variable,
        penalties: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        symbols = Symbols.of(*system.kind)
        chosen = []
        for constraint in constraints:
            relation = read(constraint.expression, symbols)
            if relation.on == on:
                chosen.append((constraint, relation))

        values = [relation.value for _, relation in chosen]
        variable = symbols.x if on == "state" else symbols.u
        super().__init__(Formulas.of(values, variable, symbols.p), system.vector())
        self.texts = [constraint.expression for constraint, _ in chosen]
        self.equality = np.array([relation.is_equality for _, relation in chosen], dtype=bool)

        # Weight of the slack of a soft constraint, nan for a hard one, (c,).
        self.penalty = np.full(len(chosen), np.nan)
        for row, (constraint, relation) in enumerate(chosen):
            if constraint.soft and on == "state" and not relation.is_equality:
                # The place of a UAV, r0 - l R e + ..., contains that of the payload.
                is_of_place = bool(self.depends[row, state.R0].any())
                default = penalties[0] if is_of_place else penalties[1]
                self.penalty[row] = default if constraint.penalty is None else constraint.penalty


def compile_constraints(
    constraints: Sequence[ConstraintSection], system: System
) -> tuple[UserConstraints, UserConstraints]:
    """Read the user's constraints on states and on inputs.

    Raises: SettingsError: one cannot be read.
    """
    on_states = UserConstraints(constraints, system, "state")
    on_inputs = UserConstraints(constraints, system, "input")
    return on_states, on_inputs


def check_costs(
    terms: Sequence[CostTerm], system: System, x_hover: Array, X_reference: Iterable[Array] = ()
) -> None:
    """Check that cost terms can be read, and are finite wherever a control law is about.

    That is hover, (n,), and the states of a flat reference, (n,) each. Raises: SettingsError: the
    first that is not.
    """
    costs = UserCosts(terms, system)
    costs.about(x_hover)
    if len(costs):
        for x in X_reference:
            costs.about(x, ON_REFERENCE)


def check_constraints(
    constraints: Sequence[ConstraintSection], system: System, x: Array, u: Array
) -> None:
    """Check that constraints can be read and are finite at the start, x, (n,), and hover, u, (m,).

    Those on inputs are hard: a team that cannot hover within them falls.

    Raises: SettingsError: the first that is not, or that hover breaks.
    """
    on_states, on_inputs = compile_constraints(constraints, system)
    for part, point in ((on_states, x), (on_inputs, u)):
        for text, value, slope in zip(part.texts, *part.at(point), strict=True):
            _check_finite(f"constraint {text!r}", value, slope, "at the start")

    values, _ = on_inputs.at(u)
    excess = np.where(on_inputs.equality, np.abs(values), values)
    for text, by in zip(on_inputs.texts, excess, strict=True):
        if by > _KEPT_WITHIN:
            expected = "expected inputs that allow hover, as a constraint on them is hard"
            raise SettingsError(
                f"constraint {text!r}: {expected}, got one broken there by {by:.4g}"
            )


def _check_finite(label: str, value: float, slope: Array, where: str) -> None:
    """Check the value and the gradient of an expression. Raises: SettingsError."""
    if not np.isfinite([value, *slope]).all():
        worst = slope[~np.isfinite(slope)][0] if np.isfinite(value) else value
        kind = "slope" if np.isfinite(value) else "value"
        expected = f"expected a finite value and slope {where}"
        raise SettingsError(f"{label}: {expected}, got the {kind} {worst}")


def _parsed(text: str, label: str) -> ast.expr:
    """Return the syntax tree of a text. Raises: SettingsError."""
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise SettingsError(f"{label}: cannot be read ({error})") from error


def _scalar(tree: ast.expr, symbols: Symbols, label: str) -> ca.SX:
    """Return the value of a syntax tree, one number. Raises: SettingsError."""
    try:
        value = ca.SX(_evaluate(tree, _names(symbols), label))
    except _FAILURES as error:
        # The last argument is the text: OverflowError(34, "Numerical result out of range").
        lines = str(error.args[-1]).strip().splitlines() if error.args else []
        detail = lines[-1] if lines else type(error).__name__
        raise SettingsError(f"{label}: cannot be evaluated ({detail})") from error
    if value.shape != (1, 1):
        raise SettingsError(f"{label}: expected a scalar, got shape {value.shape}")
    return value


@lru_cache(maxsize=1)  # the texts of a scenario are read one after the other
def _names(symbols: Symbols) -> dict[str, Any]:
    """Return the names of a text and their values."""
    x = symbols.x
    u = symbols.u
    names = {
        "r0": x[state.R0],
        "v0": x[state.V0],
        "Theta0": x[state.THETA0],
        "omega0": x[state.OMEGA0],
        "pi": ca.pi,
    }
    turning = "rate" if symbols.rates else "tau"
    for i, position in enumerate(uav_positions(symbols)):
        block = x[state.uav_slice(i)]
        inputs = u[state.input_slice(i)]
        names |= {
            f"r{i + 1}": position,
            f"e{i + 1}": block[state.E],
            f"Omega{i + 1}": block[state.ROD_RATE],
            f"Theta{i + 1}": block[state.THETA],
            f"omega{i + 1}": block[state.OMEGA],
            f"thrust{i + 1}": inputs[0],
            f"{turning}{i + 1}": inputs[1:],
        }
    return names


def _evaluate(node: ast.AST, names: dict[str, Any], label: str) -> Any:
    """Return the value of a node; numbers must be finite. Raises: SettingsError."""
    value = _value(node, names, label)
    if not isinstance(value, ca.SX) and not np.isfinite(np.asarray(value, dtype=np.float64)).all():
        raise SettingsError(f"{label}: {ast.unparse(node)!r} is not a finite number")
    return value


def _value(node: ast.AST, names: dict[str, Any], label: str) -> Any:
    """Return the value of a node. Raises: SettingsError: it is none of those allowed."""
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.Name(id=name):
            if name not in names:
                known = ", ".join(sorted(names))
                raise SettingsError(f"{label}: unknown name {name!r}; known: {known}")
            return names[name]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_evaluate(operand, names, label))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            operands = _evaluate(left, names, label), _evaluate(right, names, label)
            return _OPERATORS[type(op)](*operands)
        case ast.Subscript(value=value, slice=ast.Constant(value=int() as index)) if not isinstance(
            index, bool
        ):
            return _component(_evaluate(value, names, label), index, ast.unparse(node), label)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            if name not in _FUNCTIONS:
                known = ", ".join(_FUNCTIONS)
                raise SettingsError(f"{label}: unknown function {name!r}; known: {known}")
            return _FUNCTIONS[name](*[_evaluate(argument, names, label) for argument in arguments])
    expected = "expected numbers, names, components such as r0[2], + - * / ** and functions"
    raise SettingsError(f"{label}: {ast.unparse(node)!r} is not allowed; {expected}")


def _component(vector: Any, index: int, text: str, label: str) -> Any:
    """Return a component of a vector. Raises: SettingsError: it has no such one."""
    size = vector.numel() if isinstance(vector, ca.SX) else 1
    if size == 1:
        raise SettingsError(f"{label}: {text!r}: expected a component of a vector, got a number")
    if not 0 <= index < size:
        raise SettingsError(f"{label}: {text!r}: expected a component 0 to {size - 1}")
    return vector[index]
