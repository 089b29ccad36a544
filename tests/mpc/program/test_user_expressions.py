"""Constraints as text: what they mean, in numbers, and every text that is refused."""

from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import Any

import casadi as ca
import numpy as np
import pytest

from tests.support.systems import disturbed, paper_setup
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.symbols import Symbols
from transport.mpc.program.user_expressions import (
    Relation,
    UserConstraints,
    Variable,
    check_constraints,
    check_costs,
    compile_constraints,
    read,
)
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    CostTerm,
    SettingsError,
)

# Hand computation and compiled expression differ by rounding only; the largest value here is about
# 500.
ROUNDING = 1e-11
# Central differences: truncation about step^2 times a third derivative, rounding about 1e-13 /
# step.
STEP, SLOPE_AGREEMENT = 1e-5, 1e-6

SYMBOLS = Symbols.of(4)


def at_a_point() -> tuple[Array, Array]:
    """A state and an input with no zeros and no two numbers alike."""
    rng = np.random.default_rng(8)
    setup = paper_setup()
    return disturbed(setup, rng, 0.2), setup.hover.u + rng.standard_normal(setup.system.m)


def evaluate(relation: Relation, x: Array, u: Array) -> float:
    """Value of a relation's expression; it must be <= 0 or = 0."""
    function = ca.Function("value", [SYMBOLS.x, SYMBOLS.u, SYMBOLS.p], [relation.value])
    return float(function(x, u, paper_setup().system.vector()))


def uav_position(x: Array, i: int) -> Array:
    """r_i by the kinematics (1), 0-based, with R0 from elementary rotations about z, y and x."""
    roll, pitch, yaw = x[state.THETA0]
    Rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    Ry = np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    Rz = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    uav = paper_setup().system.uavs[i]
    return np.asarray(
        x[state.R0] + Rz @ Ry @ Rx @ (uav.rho - uav.rod_length * x[state.uav_slice(i)][state.E])
    )


def block(x: Array, i: int) -> Array:
    """States of UAV i, 0-based."""
    return x[state.uav_slice(i)]


# Text, and left minus right side (right minus left for >=) by hand.
Hand = Callable[[Array, Array], float]
GOOD: dict[str, Hand] = {
    "r0[2] <= -2": lambda x, u: x[2] + 2.0,
    "r0[2] >= -2": lambda x, u: -2.0 - x[2],
    "r0[0] == 1.5": lambda x, u: x[0] - 1.5,
    "-2 <= r0[2]": lambda x, u: -2.0 - x[2],
    "v0[1] <= +1": lambda x, u: x[4] - 1.0,
    "Theta0[0] - Theta0[2] <= pi / 6": lambda x, u: x[6] - x[8] - np.pi / 6.0,
    "omega0[2] ** 2 <= 0.25": lambda x, u: x[11] ** 2 - 0.25,
    "r1[0] <= 3": lambda x, u: uav_position(x, 0)[0] - 3.0,
    "norm(r1 - r3) >= 0.8": lambda x, u: 0.8 - float(np.linalg.norm(uav_position(x, 0) - uav_position(x, 2))),
    "dot(e2, e4) >= 0.9": lambda x, u: 0.9 - float(block(x, 1)[:3] @ block(x, 3)[:3]),
    "cross(r0, v0)[1] <= 1": lambda x, u: np.cross(x[:3], x[3:6])[1] - 1.0,
    "fabs(Omega3[1]) <= 0.5": lambda x, u: abs(block(x, 2)[4]) - 0.5,
    "cos(Theta4[0]) * cos(Theta4[1]) >= 0.8": lambda x, u: 0.8 - np.cos(block(x, 3)[6]) * np.cos(block(x, 3)[7]),
    "sin(omega1[0]) + tan(omega1[1]) <= 2": lambda x, u: np.sin(block(x, 0)[9]) + np.tan(block(x, 0)[10]) - 2.0,
    "fmax(r0[0], fmin(r0[1], 0)) <= 1": lambda x, u: max(x[0], min(x[1], 0.0)) - 1.0,
    "sqrt(exp(v0[0])) <= 2": lambda x, u: np.exp(x[3] / 2.0) - 2.0,
    "thrust1 + thrust2 <= 60": lambda x, u: u[0] + u[4] - 60.0,
    "thrust3 == thrust4": lambda x, u: u[8] - u[12],
    "norm(tau2) <= 0.5": lambda x, u: float(np.linalg.norm(u[5:8])) - 0.5,
    "tau4[2] * thrust1 >= -1": lambda x, u: -1.0 - u[15] * u[0],
}  # fmt: skip


@pytest.mark.parametrize("text", GOOD)
def test_values_by_hand(text: str) -> None:
    """A text is left minus right side, must be <= 0 or = 0 as in paper (18)-(19), and knows states from inputs."""
    x, u = at_a_point()
    relation = read(text, SYMBOLS)
    assert evaluate(relation, x, u) == pytest.approx(GOOD[text](x, u), abs=ROUNDING)
    assert relation.is_equality == ("==" in text)
    assert relation.on == ("input" if "thrust" in text or "tau" in text else "state")


@pytest.mark.parametrize("text", GOOD)
def test_slopes_by_finite_differences(text: str) -> None:
    """Compiled slopes, the gradients of paper (20)-(21), are central differences of the compiled values."""
    x, u = at_a_point()
    system = paper_setup().system
    on_state, on_input = compile_constraints((ConstraintSection(expression=text),), system)
    compiled, point = (on_state, x) if len(on_state) else (on_input, u)
    assert len(on_state) + len(on_input) == 1
    moved = np.eye(len(point)) * STEP
    differences = [
        (compiled.at(point + d)[0][0] - compiled.at(point - d)[0][0]) / (2.0 * STEP) for d in moved
    ]
    assert np.abs(compiled.at(point)[1][0] - differences).max() < SLOPE_AGREEMENT
    assert compiled.at(point)[0][0] == pytest.approx(GOOD[text](x, u), abs=ROUNDING)


BAD = {
    "r0[2] <=": "cannot be read",
    "": "cannot be read",
    "r0[2] = 1": "cannot be read",
    "r0[2] <= 1\0": "cannot be read",
    "(" * 300 + "r0[2]" + ")" * 300 + " <= 0": "cannot be read",
    "r0[2]": "expected two sides and one of <=, >=, ==",
    "-3 <= r0[2] <= -2": "expected two sides and one of <=, >=, ==",
    "r0[2] <= 0 and r0[1] <= 0": "expected two sides and one of <=, >=, ==",
    "r0[2] < -2": "expected two sides and one of <=, >=, ==",
    "r0[2] != -2": "expected two sides and one of <=, >=, ==",
    "r5[0] <= 1": "unknown name 'r5'; known: Omega1, ",
    "payload[0] <= 1": "unknown name 'payload'; known: Omega1, ",
    "norm <= 1": "unknown name 'norm'; known: Omega1, ",
    "r0.T[0] <= 1": "'r0.T' is not allowed",
    "__import__('os').system('true') <= 1": "is not allowed",
    "__import__('os') <= r0[0]": "unknown function '__import__'; known: dot, ",
    "abs(r0[0]) <= 1": "unknown function 'abs'; known: dot, cross, sin, cos, tan, sqrt, exp, fabs",
    "r0[3] <= 1": "'r0[3]': expected a component 0 to 2",
    "(lambda: r0[0])() <= 1": "is not allowed",
    "[r0[0] for _ in r0][0] <= 1": "is not allowed",
    "r0[2] <= '1'": "\"'1'\" is not allowed",
    "r0[2] <= True": "'True' is not allowed",
    "r0[2] <= 1j": "'1j' is not allowed",
    "r0[2] <= None": "'None' is not allowed",
    "r0[-1] <= 1": "'r0[-1]' is not allowed",
    "r0[0:2] <= 1": "'r0[0:2]' is not allowed",
    "norm(*r0) <= 1": "'*r0' is not allowed",
    "norm(a=r0) <= 1": "is not allowed",
    "r0[0] // 2 <= 1": "is not allowed",
    "~r0[0] <= 1": "is not allowed",
    "thrust1[1] <= 1": "expected a component of a vector, got a number",
    "pi[0] <= r0[0]": "expected a component of a vector, got a number",
    "norm(r0, r1) <= 1": "cannot be evaluated",
    "sin() <= r0[0]": "cannot be evaluated",
    "cross(r0, 1)[0] <= 1": "cannot be evaluated",
    "r0[0] <= (-1) ** 0.5": "cannot be evaluated",
    "r0 <= 1": "expected a scalar, got shape (3, 1)",
    "r1 <= r2": "expected a scalar, got shape (3, 1)",
    "r0[2] <= thrust1": "expected states or inputs, got both",
    "pi <= 4": "expected states or inputs, got neither",
    "r0[2] - r0[2] <= 1": "expected states or inputs, got neither",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_text_is_refused(text: str) -> None:
    """A text that is no constraint of the paper's (18)-(19) is refused with the text itself and the reason."""
    with pytest.raises(SettingsError) as refused:
        read(text, SYMBOLS)
    assert repr(text) in str(refused.value)
    assert BAD[text] in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "r0[2] <= 1 / 0",
        "r0[2] <= 10.0 ** 1000",
        "-" * 5000 + "r0[2] <= 0",
        "r0[2] + " * 3000 + "r0[2] <= 0",
        "r0[2] <= 1e400",
        "sqrt(-1) <= r0[0]",
        "r0[True] <= 1",
        "r0[0] <= -9**9**9",
        "r0[0] <= 3**20000000",
    ],
    ids=[
        "division by zero",
        "overflow",
        "deep",
        "long",
        "infinite",
        "complex",
        "boolean index",
        "tower",
        "millions of digits",
    ],
)
def test_arithmetic_that_fails_is_refused(text: str) -> None:
    """A text whose own arithmetic or nesting breaks Python is refused like any other, not passed on as its error."""
    with pytest.raises(SettingsError):
        read(text, SYMBOLS)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("sqrt(r0[0]) <= 1", "expected a finite value and slope at the start, got the slope inf"),
        ("1 / r0[0] <= 1", "expected a finite value and slope at the start, got the value inf"),
        ("1 / tau1[0] <= 1", "expected a finite value and slope at the start, got the value inf"),
    ],
)
def test_constraints_are_finite_at_the_start(text: str, problem: str) -> None:
    """A constraint without a value or slope at the first state and input is refused with its text."""
    setup = paper_setup()
    with pytest.raises(SettingsError) as refused:
        check_constraints(
            [ConstraintSection(expression=text)], setup.system, setup.hover.x, setup.hover.u
        )
    assert repr(text) in str(refused.value)
    assert problem in str(refused.value)


@pytest.mark.parametrize(
    ("text", "by"),
    [("thrust1 + thrust2 + thrust3 + thrust4 <= 80", "8.29"), ("tau1[0] == 0.2", "0.2")],
)
def test_hard_constraints_allow_hover(text: str, by: str) -> None:
    """A team that may not hover falls, whatever it plans."""
    setup = paper_setup()
    with pytest.raises(SettingsError, match=f"expected inputs that allow hover.* by {by}$"):
        check_constraints(
            [ConstraintSection(expression=text)], setup.system, setup.hover.x, setup.hover.u
        )


def test_integers_of_a_text_are_floats() -> None:
    """Arithmetic of constants has the rounding of floats, where integers would have all digits."""
    setup = paper_setup()
    beyond_53_bits = [ConstraintSection(expression="r0[0] <= 3**40 + 1 - 3**40")]
    on_state, _ = compile_constraints(beyond_53_bits, setup.system)
    value, _ = on_state.at(setup.hover.x)
    assert value[0] == 0.0


@pytest.mark.parametrize(
    ("expression", "fields", "expected"),
    [
        ("r0[2] >= -12", {}, 3.0),
        ("r2[0] <= 1", {}, 3.0),  # the place of a UAV goes with that of the payload
        ("norm(r1 - r3) >= 0.8", {}, 3.0),
        ("norm(v0) <= 2", {}, 5.0),
        ("norm(v0) <= 2", {"penalty": 7.0}, 7.0),
        ("norm(v0) <= 2", {"soft": False}, nan),
        ("v0[0] == 0", {"penalty": 7.0}, nan),
        ("thrust1 <= 30", {"penalty": 7.0}, nan),
    ],
)
def test_soft_constraints_have_a_penalty(
    expression: str, fields: dict[str, Any], expected: float
) -> None:
    """Its own, or that of places or of all others; equalities and constraints on inputs are hard, (30d)."""
    constraint = ConstraintSection(expression=expression, **fields)
    system = paper_setup().system
    kinds: list[Variable] = ["state", "input"]
    found = [UserConstraints([constraint], system, on, (3.0, 5.0)).penalty for on in kinds]
    on_input = expression.startswith("thrust")
    assert len(found[not on_input]) == 0
    assert found[on_input] == pytest.approx([expected], nan_ok=True)


def test_costs_are_finite_along_the_reference() -> None:
    """A term that is finite at hover is refused where the reference leads to its pole."""
    setup = paper_setup()
    term = CostTerm(expression="1 / (r0[0] - 1)", weight=1.0)
    at_pole = setup.hover.x.copy()
    at_pole[state.R0] = [1.0, 0.0, 0.0]
    check_costs([term], setup.system, setup.hover.x, [setup.hover.x])
    with pytest.raises(
        SettingsError, match=r"cost '1 / \(r0.* on the reference, got the value inf"
    ):
        check_costs([term], setup.system, setup.hover.x, [setup.hover.x, at_pole])


def test_commanded_rates_have_their_name() -> None:
    """With an inner loop the inputs beside the thrust are `ratei`, and moments are no inputs."""
    system = replace(paper_setup().system, rate_gains=np.ones(3))
    rate, moment = (ConstraintSection(expression=f"{name}2[1] <= 0.5") for name in ("rate", "tau"))
    values, _ = UserConstraints([rate], system, "input").at(np.arange(16.0))
    assert values.tolist() == [5.5]
    with pytest.raises(SettingsError, match="unknown name 'tau2'"):
        UserConstraints([moment], system, "input")
