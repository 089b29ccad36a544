"""The preview against the explicit tracking problem.

One dense least-squares problem over the whole maneuver.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pytest

from tests.support import naive
from tests.support.linear_model import (
    PERIOD_S,
    Difference,
    difference,
    reference_states,
    small_state,
)
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.phase import Profile
from transport.model.physics.hover import Hover, hover
from transport.model.physics.parameters import System, table_1
from transport.model.state import input_indices
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam, Regulator, regulator
from transport.mpc.law.present_law import Regulation
from transport.mpc.law.preview import preview
from transport.mpc.program.stage_cost import Cost
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import ControllerSettings, CostTerm, Weights

# Relative to the largest value: two solutions of one linear problem whose Hessian has a condition
# of around 1e5.
AGREEMENT = 1e-8
# N and N m, and per unit of state: rounding of products of the entries of P, which reach 1e3.
ROUNDING = 1e-10

INSTANTS = 45
# Steps after which every mode of the closed loop that has a cost has decayed.
STEPS_TO_REST = 5000
PAYLOAD = Weights(position=0.1, payload_position=1.0, payload_velocity=0.1)


@dataclass(frozen=True, slots=True)
class Problem:
    """A tracking problem in full coordinates.

    Attributes:
        model: Difference equation with the feedback of the UAVs without agents in it.
        controlled: Inputs of those that have agents.
        drift: What the reference and the UAVs without agents add at each step, (K, n).
        on_reference: Inputs of the latter on the reference, from those at hover, (K, m_u).
        X_ref: Reference states, (K, n).
        pull: Half the gradient of the stage cost at zero deviation, (K, n).
    """

    system: System
    at: Hover
    cost: Cost
    law: Regulator
    model: Difference
    controlled: npt.NDArray[np.intp]
    X_ref: Array
    pull: Array
    drift: Array
    on_reference: Array


@lru_cache
def problem(
    profile: Profile,
    pulled: str,
    gone: tuple[int, ...] = (),
    fail_safe: str = "level",
    weights: Weights = PAYLOAD,
) -> Problem:
    """The paper's system on a short move, with a pull that passes, one that lasts, or none.

    UAVs without agents keep level, follow the reference, or another motion.
    """
    system = table_1()
    at = hover(system)
    cost, model = Cost(weights, system, at), difference(system, at)
    safe = FailSafe(system, at.u, None if fail_safe == "level" else at.x[None])
    uncontrolled = {uav: safe.gain(uav) for uav in gone}
    K = np.zeros((len(at.u), len(at.x)))
    for uav, gain in uncontrolled.items():
        K[state.input_slice(uav)] = gain
    controlled = np.setdiff1d(np.arange(len(at.u)), input_indices(gone))
    X_ref = reference_states(system, at, profile, INSTANTS)
    pull = np.zeros_like(X_ref)
    if pulled != "none":
        # A pull through the outputs, as a cost term has it; headings are not pulled.
        slope = model.C.T @ (cost.Q * np.random.default_rng(2).standard_normal(len(cost.Q)))
        pull = np.sin(np.arange(INSTANTS) / 5.0)[:, None] * slope * 0.05
        pull[-1] = 0.02 * slope if pulled == "lasting" else 0.0
    others = input_indices(gone)
    on_reference = np.zeros((INSTANTS, len(others)))
    if fail_safe == "another motion":
        passing = np.sin(np.arange(INSTANTS) / 7.0) * np.linspace(1.0, 0.0, INSTANTS)
        on_reference = passing[:, None] * np.random.default_rng(5).standard_normal(len(others))
    # x_ref(k+1) is where the team is to be; without deviation it gets to A x_ref(k) + B v(k).
    reference = np.vstack([X_ref, X_ref[-1:]]) - at.x
    drift = reference[:-1] @ model.A.T + on_reference @ model.B[:, others].T - reference[1:]
    hovering = HoveringTeam(model=Model(system), hover=at, cost=cost, uncontrolled=uncontrolled)
    return Problem(
        system=system,
        at=at,
        cost=cost,
        law=regulator(hovering, PERIOD_S),
        model=Difference(model.A + model.B @ K, model.B[:, controlled], model.C),
        controlled=controlled,
        X_ref=X_ref,
        pull=pull,
        drift=drift,
        on_reference=on_reference,
    )


def slope_at_the_end(of: Problem) -> Array:
    """Return the part of the cost-to-go's half slope from the last pull, held for ever, summed step by step, (n,)."""
    closed = of.model.A + of.model.B @ of.law.K[of.controlled]
    p = np.zeros(len(of.at.x))
    for _ in range(STEPS_TO_REST):
        p = closed.T @ p + of.pull[-1]
    return p


def dense(of: Problem, xi0: Array) -> tuple[Array, Array, Array]:
    """The optimum over the whole maneuver from stacked matrices.

    No recursion, no coordinates of the manifold.

    min over du of sum_{k<K} (xi' C'QC xi + 2 pull' xi + du' R du) + xi(K)' P xi(K) + 2 p(K)' xi(K)
    subject to xi(k+1) = A xi(k) + B du(k) + drift(k).

    Returns: du (K, m_c), xi (K + 1, n), and half the derivative of the optimal cost with respect to
        xi0, (n,).
    """
    steps, n = len(of.X_ref), len(of.at.x)
    A, B, C = of.model.A, of.model.B, of.model.C
    G, Gamma = naive.stacked_state(A, steps), naive.stacked_input(A, B, steps)
    free = naive.simulate(A, np.eye(n), np.zeros(n), of.drift).reshape(-1) + G @ xi0
    stage = C.T @ (of.cost.Q[:, None] * C)
    weight = np.zeros(((steps + 1) * n, (steps + 1) * n))
    for k in range(steps):
        weight[k * n : (k + 1) * n, k * n : (k + 1) * n] = stage
    weight[-n:, -n:] = of.law.T @ of.law.P @ of.law.T.T
    linear = np.concatenate([of.pull.reshape(-1), slope_at_the_end(of)])
    H = Gamma.T @ weight @ Gamma + np.diag(np.tile(of.cost.R[of.controlled], steps))
    du = -np.linalg.solve(H, Gamma.T @ (weight @ free + linear))
    xi = free + Gamma @ du
    # At the optimum the inputs' own part of the derivative vanishes.
    return du.reshape(steps, -1), xi.reshape(steps + 1, n), G.T @ (weight @ xi + linear)


CASES: dict[str, tuple[Profile, str, tuple[int, ...], str]] = {
    "lasting pull": ("min_jerk", "lasting", (), "level"),
    "one gone, level": ("ramp", "passing", (2,), "level"),
    "one gone, follows": ("ramp", "passing", (2,), "reference"),
    "one gone, another motion": ("ramp", "passing", (2,), "another motion"),
}
SLOW: dict[str, tuple[Profile, str, tuple[int, ...], str]] = {
    "step": ("step", "none", (), "level"),
    "passing pull": ("ramp", "passing", (), "level"),
}
PARAMETERS = [
    *(pytest.param(case, id=name) for name, case in CASES.items()),
    *(pytest.param(case, id=name, marks=pytest.mark.slow) for name, case in SLOW.items()),
]


@pytest.mark.parametrize("case", PARAMETERS)
def test_preview_is_the_optimum_of_the_tracking_problem(
    case: tuple[Profile, str, tuple[int, ...], str],
) -> None:
    """Along the optimal path every input is K xi + feedforward, from any first deviation, (36b), (36c).

    Half the derivative of the optimal cost with respect to that deviation is P xi + p(0).
    """
    of = problem(*case)
    found, T = preview(of.law, of.X_ref, of.pull, of.on_reference), of.law.T
    for size in (0.0, 0.1):
        xi0 = small_state(of.at, np.random.default_rng(3), size)
        du, xi, derivative = dense(of, xi0)
        by_law = xi[:-1] @ of.law.K[of.controlled].T + found.feedforward[:, of.controlled]
        assert np.abs(by_law - du).max() < AGREEMENT * np.abs(du).max()
        expected, value = T.T @ derivative, of.law.P @ T.T @ xi0 + T.T @ found.slope[0]
        assert np.abs(value - expected).max() < AGREEMENT * np.abs(expected).max()
    others = np.setdiff1d(np.arange(len(of.at.u)), of.controlled)
    np.testing.assert_array_equal(found.feedforward[:, others], of.on_reference)
    assert np.abs(found.feedforward).max() > 0.01, "a zero feedforward would compare nothing"


@pytest.mark.parametrize("rods", ["vertical", "leaning"])
def test_a_reference_at_rest_asks_for_nothing(rods: str) -> None:
    """Hover at any place, with vertical or leaning rods, needs no feedforward and no slope, (36b), (36c)."""
    system = table_1()
    e = None
    if rods == "leaning":
        outwards = np.array([uav.rho for uav in system.uavs]) * [1.0, 1.0, 0.0]
        # The UAVs stand wider than their attachment points.
        e = np.array([0.0, 0.0, 1.0]) - 0.8 * outwards
        e /= np.linalg.norm(e, axis=1)[:, None]
    at = hover(system, e)
    cost = Cost(PAYLOAD, system, at)
    law = regulator(HoveringTeam(model=Model(system), hover=at, cost=cost), PERIOD_S)
    X_ref = np.tile(at.x, (20, 1))
    X_ref[:, state.R0] += [3.0, -4.0, -10.0]
    found = preview(law, X_ref, np.zeros_like(X_ref))
    assert np.abs(found.feedforward).max() < ROUNDING
    assert np.abs(found.slope).max() < ROUNDING


@pytest.mark.parametrize("pulled", ["none", "passing", "lasting"])
def test_a_long_rest_at_the_end_changes_nothing(pulled: str) -> None:
    """Instants at rest after the maneuver leave the ones before as they are.

    Without a lasting pull they are zero.
    """
    of = problem("min_jerk", pulled)
    rest = 200
    X_ref = np.concatenate([of.X_ref, np.repeat(of.X_ref[-1:], rest, axis=0)])
    pull = np.concatenate([of.pull, np.repeat(of.pull[-1:], rest, axis=0)])
    short, long = preview(of.law, of.X_ref, of.pull), preview(of.law, X_ref, pull)
    for one, other in ((short.slope, long.slope), (short.feedforward, long.feedforward)):
        assert np.abs(one - other[: len(one)]).max() <= AGREEMENT * np.abs(one).max()
        assert other[len(one) :].any() == (pulled == "lasting")


def test_beyond_the_maneuver_its_last_instant_counts() -> None:
    """After the last instant the reference rests: feedforward and slope are those of the last one."""
    of = problem("min_jerk", "none")
    settings = ControllerSettings(
        prediction="closed_loop", terminal="riccati", preview=True, weights=PAYLOAD,
        cost=(CostTerm(expression="e1[0] - 0.02", weight=0.5),),
    )  # fmt: skip
    regulation = Regulation(Model(of.system), of.at, settings, Sampled(X=of.X_ref))
    ahead = regulation.current.feedforward(INSTANTS - 2, 6)
    assert ahead.shape == (6, len(of.at.u))
    assert ahead[1].any()
    np.testing.assert_array_equal(ahead[1:], np.tile(ahead[1], (5, 1)))
    ends = [
        regulation.current.cost_to_go(of.at.x, of.at.x, None, k)
        for k in (INSTANTS - 1, INSTANTS + 100)
    ]
    assert ends[0] is not None
    assert ends[1] is not None
    np.testing.assert_array_equal(ends[0].slope, ends[1].slope)
    assert ends[0].slope.any()
