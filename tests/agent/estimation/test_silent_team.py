"""Other agents about which information is old, in the covariance of the filter: docs/equations.md (63c)."""

from dataclasses import dataclass

import numpy as np
import pytest

from tests.support import runs
from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.agent.estimation.filter.silent_agents import SilentTeam
from transport.model.arrays import Array
from transport.mpc.alone.fail_safe import FailSafe

ROUNDING = 1e-12


@dataclass(frozen=True)
class Answering:
    """How the inputs of a period answer to the state."""

    unannounced: Unannounced
    K: Array | None


@pytest.mark.parametrize("has_law", [False, True])
def test_noise_is_that_of_its_equation(*, has_law: bool) -> None:
    """Shares and correlations anywhere between 0 and 1, some inputs told."""
    setup = runs.ready("precise")
    m, n, s = setup.system.m, setup.system.n, 30
    rng = np.random.default_rng(4)
    silent = Silent(alone=rng.random(m), correlation=rng.random(m))
    by_law = rng.random(m) < 0.7
    K = rng.standard_normal((m, n)) if has_law else None
    answering = Answering(unannounced=Unannounced(by_law=by_law, by_fail_safe=~by_law), K=K)
    B, T = rng.standard_normal((s, m)), rng.standard_normal((n, s))
    root = rng.standard_normal((s, s))
    P = root @ root.T

    #   a^2 B V B'  +  B D K T P T' K' D B',    D = (1 - a) sqrt(1 - c^2)
    alone = FailSafe(setup.system, setup.hover.u, setup.hover.x[None])
    slopes = np.vstack([alone.law(uav).by_sensors() for uav in range(setup.system.N)])
    of_sensors = np.repeat(setup.sensors.noise, slopes.shape[1] // len(setup.sensors.noise)) ** 2
    expected = B @ np.diag(by_law * silent.alone**2 * (slopes**2 @ of_sensors)) @ B.T
    if K is not None:
        D = np.diag(by_law * (1.0 - silent.alone) * np.sqrt(1.0 - silent.correlation**2))
        K_T = D @ K @ T
        expected = expected + B @ K_T @ P @ K_T.T @ B.T
    found = SilentTeam(setup.run).noise(silent, answering, B, T, P)
    np.testing.assert_allclose(
        found, expected, rtol=ROUNDING, atol=ROUNDING * np.abs(expected).max()
    )
