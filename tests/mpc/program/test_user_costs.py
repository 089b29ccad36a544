"""Cost terms of the user: equal to weights on the outputs where both say the same, and effective."""

import numpy as np
import pytest

from tests.support import runs
from tests.support.systems import changed, controller, paper_setup, situation
from transport.flight.memory import simulate
from transport.model.arrays import Array
from transport.mpc.controller import Controller
from transport.mpc.program.prediction import Prediction
from transport.mpc.settings_period_horizon_weights import ControllerSettings, CostTerm, Weights
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, PlantState

OWNED = [(0,), (1, 3), (0, 1, 2, 3)]
# The same sums in another order.
ROUNDING = 1e-9


def programs(one: Controller, x: Array, u: Array, U: Array, y_ref: Array) -> tuple[Array, Array]:
    """Hessian and gradient of a controller's program."""
    linear = one.linearise(x, u)
    law = one.law(x, np.tile(x, (len(U), 1)), np.zeros_like(U))
    qp = one.condense(linear, one.predict(linear, one.discretise(linear), U, law), y_ref)
    return qp.H, qp.g


@pytest.mark.parametrize("prediction", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("owned", OWNED)
def test_a_term_that_is_an_output_adds_to_its_weight(
    owned: tuple[int, ...], prediction: str
) -> None:
    """Position errors weighted half by the weights and half by terms give the same QP as the weights alone."""
    setup = paper_setup()
    whole = ControllerSettings(
        horizon=6,
        prediction=prediction,  # type: ignore[arg-type]
        weights=Weights(position=1.0, terminal=3.0),
    )
    at = situation(setup, whole, seed=1)
    reference = at.y_ref[0]
    y_ref = np.tile(reference, (len(at.y_ref), 1))  # text knows no time
    terms = tuple(
        CostTerm(expression=f"r{i + 1}[{axis}] - ({float(reference[3 * i + axis])!r})", weight=0.5)
        for i in range(4)
        for axis in range(3)
    )
    halves = changed(whole, weights=changed(whole.weights, position=0.5), cost=terms)
    H, g = programs(controller(setup, whole, owned), at.x, at.u, at.U, y_ref)
    own_H, own_g = programs(controller(setup, halves, owned), at.x, at.u, at.U, y_ref)
    assert np.abs(own_H - H).max() <= ROUNDING * np.abs(H).max()
    assert np.abs(own_g - g).max() <= ROUNDING * np.abs(g).max()
    bare = controller(setup, changed(halves, cost=()), owned)
    assert np.abs(programs(bare, at.x, at.u, at.U, y_ref)[0] - H).max() > 1e-3 * np.abs(H).max()


def test_a_curved_term_is_expanded_about_the_present_state() -> None:
    """phi(x_0) + slope dx: what a term adds to the gradient at the free response is that of its square."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=1, weights=Weights(terminal=2.0))
    term = CostTerm(expression="norm(r1 - r3) * v0[1] + sin(Theta0[0])", weight=0.7)
    at = situation(setup, settings, seed=3)
    plain = controller(setup, settings, (0,))
    own = controller(setup, changed(settings, cost=(term,)), (0,))
    _, g = programs(plain, at.x, at.u, at.U, at.y_ref)
    _, own_g = programs(own, at.x, at.u, at.U, at.y_ref)

    linear = own.linearise(at.x, at.u)
    free = own.predict(linear, own.discretise(linear), at.U, None)
    assert isinstance(free, Prediction)

    def value(x: Array) -> float:
        return float(own.regulation.user_costs.at(x)[0][0])

    steps = 1e-6 * np.eye(len(at.x))
    slope = np.array([(value(at.x + h) - value(at.x - h)) / 2e-6 for h in steps])
    ahead = value(at.x) + slope @ free.dX_free[1]
    expected = 2.0 * 2.0 * 0.7 * ahead * (slope @ free.effect[:, 0])
    scale = (settings.upper(1) - settings.lower(1)) / 2.0
    difference = (own_g - g)[: len(scale)] / scale
    assert np.abs(difference - expected).max() <= 1e-6 * np.abs(expected).max()


def swing_m(run: Setup) -> float:
    """Largest distance of the payload from its reference along x in the last second of a flight."""
    plant_states: list[PlantState] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState):
            plant_states.append(message)

    assert simulate(run, record).outcome == "completed"
    end = plant_states[-20:]
    times = np.array([run.settings.sampling_period_s * plant_state.tick for plant_state in end])
    x = np.array([plant_state.x[0] for plant_state in end])
    return float(np.abs(x - run.reference.states(times)[:, 0]).max())


@pytest.mark.parametrize("prediction", ["open_loop", "closed_loop"])
def test_the_payload_speed_can_be_penalised(prediction: str) -> None:
    """A payload with a weight on its speed swings less after a move than one without."""
    hover, move = "duration_s={},displacement_m=[0,0,0]", "duration_s=1.0,displacement_m=[0.5,0,0]"
    phases = f"{{name='wait',{hover.format(1.0)}}},{{name='move',{move}}},{{name='hover',{hover.format(4.0)}}}"
    common = (
        f"maneuver.phase=[{phases}]",
        f"controller.prediction={prediction}",
        "controller.relaxation=auto",
    )
    penalised_input = "controller.cost=[{expression='v0[0]',weight=0.3}]"
    assert swing_m(runs.setup(*common, penalised_input)) < 0.8 * swing_m(runs.setup(*common))
