"""What the law of a team is made of: the team it is for, the motion it leads to, and what UAVs alone do on it."""

import numpy as np
import pytest

from tests.mpc.law.test_regulation import INSTANTS, LQ
from tests.support.linear_model import reference_states
from tests.support.systems import changed
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.model.state import input_slice
from transport.mpc.law.infinite_horizon_lqr import TeamFailures
from transport.mpc.law.present_law import Regulation
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import ControllerSettings

SYSTEM = table_1()
AT_REST = hover(SYSTEM)
FOLLOW = changed(LQ, fail_safe="follow")
ROUNDING = 1e-12
NONE = frozenset[int]()


def regulation(settings: ControllerSettings) -> Regulation:
    """Return the law of the paper's team along a move with corners."""
    X_ref = reference_states(SYSTEM, AT_REST, "ramp", INSTANTS)
    return Regulation(Model(SYSTEM), AT_REST, settings, Sampled(X=X_ref))


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (TeamFailures(NONE, frozenset({2}), frozenset({2})), None),
        # Two rods in a line hold no payload.
        (
            TeamFailures(frozenset({0}), frozenset({2}), frozenset({2})),
            TeamFailures(off=frozenset({2}), released=frozenset({2})),
        ),
        # Three do not hold it with the fourth on its rod.
        (TeamFailures(frozenset({0}), frozenset({2}), NONE), TeamFailures(gone=frozenset({0}))),
        (TeamFailures(NONE, frozenset({2}), NONE), TeamFailures()),
    ],
    ids=["as it is", "without the dead agents", "without the failures", "the whole"],
)
def test_where_a_team_has_no_law_that_of_fewer_failures_holds(
    asked: TeamFailures, expected: TeamFailures | None
) -> None:
    """First the losses of agents are left out, then the failures instead, then both: (45), (50), (51)."""
    one = Regulation(Model(SYSTEM), AT_REST, LQ)
    one.form(*asked)
    assert one.current.team == (expected or asked)


def test_the_undisturbed_motion_keeps_the_limits_of_the_inputs() -> None:
    """Its inputs are those of the law within the limits of controllers, some at them: (31f)."""
    most_N = 1.005 * float(AT_REST.u[0])
    limits = changed(LQ.limits, thrust_N=(0.995 * float(AT_REST.u[0]), most_N))
    one = regulation(changed(FOLLOW, limits=limits))
    motion = one.fail_safe.motion
    assert motion is not None
    X_ref = reference_states(SYSTEM, AT_REST, "ramp", INSTANTS)
    limited = 0
    for k in range(INSTANTS):
        x, u = motion.at(k)
        by_law = one.inputs(x, X_ref[k], None, k)
        assert by_law is not None
        expected = np.clip(by_law, one.crew.settings.lower(4), one.crew.settings.upper(4))
        np.testing.assert_allclose(u, expected, atol=ROUNDING)
        limited += int((expected != by_law).any())
    assert limited


@pytest.mark.parametrize("preview", [True, False])
def test_what_uavs_alone_do_on_the_reference(*, preview: bool) -> None:
    """v(k) = K_u (x_ref(k) - x*(k)) + u*_u(k) - u_hov,u of each, and nothing at all at rest, (45a)."""
    one = regulation(changed(FOLLOW, preview=preview))
    gone = (3, 1)
    one.form(gone, (), ())
    motion = one.fail_safe.motion
    assert motion is not None
    X_ref = reference_states(SYSTEM, AT_REST, "ramp", INSTANTS)

    def found(k: int, uav: int) -> Array:
        return one.current.feedforward(k, 1)[0, input_slice(uav)]

    for uav in gone:
        own = input_slice(uav)
        gain = one.fail_safe.gain(uav)
        for k in (10, 25, INSTANTS + 20, motion.last - 1):
            x, u = motion.at(k)
            expected = gain @ (X_ref[min(k, INSTANTS - 1)] - x) + (u - AT_REST.u)[own]
            np.testing.assert_allclose(found(k, uav), expected, atol=ROUNDING)
        assert np.abs(found(25, uav)).max() > 1e-3
        assert found(motion.last - 1, uav).any()
        for k in (motion.last, motion.last + 100):
            assert not found(k, uav).any()


@pytest.mark.parametrize(
    ("change", "has_motion"),
    [
        ({}, True),
        ({"fail_safe": "level"}, False),
        ({"prediction": "open_loop"}, False),
        ({"motor_lag_s": 0.03}, False),
    ],
    ids=["follow", "level", "open loop", "motors"],
)
def test_an_undisturbed_motion_is_that_of_a_law_which_uavs_follow(
    change: dict[str, object], *, has_motion: bool
) -> None:
    """Without one, or with motors whose inputs a setpoint lacks, UAVs alone follow the reference, (31f)."""
    one = regulation(changed(FOLLOW, **change))
    assert (one.fail_safe.motion is not None) is has_motion
    assert one.fail_safe.follows is (change.get("fail_safe") != "level")
