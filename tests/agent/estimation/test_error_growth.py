"""Growth of the errors of an estimate: transition by differences of the model, noise by its numbers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.support.runs import VEHICLE, setup
from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.agent.estimation.filter.assumed_noise import ForceNoise
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import FilterPeriod
from transport.agent.estimation.filter.manifold import UAV_BLOCKS
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.filter.unknown_forces import COUNT, MASS_ERROR
from transport.model import state
from transport.model.arrays import Array, padded
from transport.model.linear.motor_lag import Period, integrate
from transport.mpc.alone.fail_safe import FailSafe

PERIOD_S = 0.05
FORCES = "controller.disturbance.estimate=true"
LAG = "controller.motor_lag_s=0.08"
DIFFERENCE = 1e-4  # share of a deviation, of central differences
# The filter linearises at the beginning of a period: share of the larger of effect and first deviation.
SAME = 0.1
SAME_VARIANCE = 0.3  # of a noise, as share of it: small parts are of higher order in the period

RODS = 12 + (10 * np.arange(4)[:, None] + np.arange(2)).ravel()  # coordinates of rod directions
BY_LAW = np.repeat([False, True, False, True], state.INPUTS)
BY_FAIL_SAFE = np.repeat([False, False, True, False], state.INPUTS)


class Growth:
    """A team in motion whose motors lag behind changed inputs, and its filter."""

    def __init__(self, *settings: str, turns_rods: bool = False) -> None:
        self.run = setup(*VEHICLE, *settings)
        self.team = TeamFilter(self.run.run)
        self.rng = np.random.default_rng(8)
        rng, system = self.rng, self.run.system
        x = self.run.hover.x
        if LAG in settings:
            x = np.concatenate([x, self.run.hover.u + 0.5 * rng.standard_normal(system.m)])
        first = self.team.first(x)
        self.s = first.covariance.basis.T.shape[1]
        self.deviations = np.sqrt(first.covariance.P.diagonal())
        self.deviations[self.team.manifold.r : self.s] = 0.5  # of actual inputs
        xi = self.deviations[: self.s] * rng.standard_normal(self.s)
        if turns_rods:
            xi[RODS + 2] = 1.0
        moving = self.team.manifold.moved(x, first.covariance.basis.T @ xi)
        unknowns = np.array([0.4, -0.3, 0.1, 0.2, 0.1, 0.0, 0.0])[: len(first.unknowns)]
        self.belief = replace(self.team.first(moving), unknowns=unknowns)
        change = np.tile([0.5, 0.02, 0.02, 0.02], system.N) * rng.standard_normal(system.m)
        self.u = self.belief.u + change
        self.K = rng.standard_normal((system.m, len(x)))

    def end(self, xi: Array, u: Array, pull: Array | float = 0.0) -> Array:
        """Return the state after the period from the belief moved by coordinates, under inputs and forces, N."""
        run, belief = self.run, self.belief
        z = self.team.manifold.moved(belief.x, belief.covariance.basis.T @ xi[: self.s])
        unknowns = belief.unknowns + xi[self.s :]
        forces = self.team.forces(replace(belief, x=z, unknowns=unknowns))
        if forces is not None:
            forces[: 3 + 3 * run.system.N] += pull
        lasting = Period(duration_s=PERIOD_S, steps=5, lag_s=run.settings.motor_lag_s)
        return integrate(run.model, z, u, lasting, forces)

    def slope(self, xi: Array, du: Array, pull: Array | float = 0.0) -> Array:
        """Return the effect of a small error xi, inputs du and forces on the coordinates at the end."""
        step = DIFFERENCE
        ends = [self.end(s * xi, self.u + s * du, s * pull) for s in (step, -step)]
        L = self.team.manifold.basis(self.period().end).L
        return np.asarray(L.T @ (ends[0] - ends[1]) / (2.0 * step))

    def period(self, **changes: object) -> FilterPeriod:
        """Return the period with all inputs told, or as changed."""
        told = np.zeros(self.run.system.m, dtype=bool)
        period = FilterPeriod(
            model=self.run.model,
            end=self.end(np.zeros(len(self.deviations)), self.u),
            u=self.u,
            forces=self.team.forces(self.belief),
            unannounced=Unannounced(by_law=told, by_fail_safe=told),
            K=None,
            correlation=0.0,
        )
        return replace(period, **changes)  # type: ignore[arg-type]

    def after(self, xi: Array, period: FilterPeriod, level: float = 1.0) -> Array:
        """Return the covariance after a period of an error along xi alone, or of none."""
        covariance = replace(self.belief.covariance, P=np.outer(xi, xi))
        belief: Belief = replace(
            self.belief, source=covariance, level=replace(self.belief.level, value=level)
        )
        return self.team.growth.after(belief, period).P


@pytest.mark.parametrize("alone", [None, 0.0, 0.4])
@pytest.mark.parametrize("settings", [(), (LAG, FORCES)], ids=["", "lag, forces"])
def test_an_error_grows_as_the_team_answers_to_it(
    settings: Sequence[str], alone: float | None
) -> None:
    """Inputs by law answer to the part of an error that others do not share, a fail-safe to all of it, (63).

    With a share alone they answer also as UAVs alone do, (63c), and forces return to zero, (63d).
    """
    growth, c = Growth(*settings, turns_rods=FORCES not in settings), 0.6
    run, belief, m = growth.run, growth.belief, growth.run.system.m
    xi = growth.deviations * growth.rng.standard_normal(len(growth.deviations))
    if FORCES not in settings:
        xi *= np.isin(np.arange(len(xi)), RODS)  # their directions turn the rates' coordinates
    else:
        xi[growth.s + MASS_ERROR] = 0.0  # its inertia, which turns the payload, is left out
    share = 0.0 if alone is None else alone
    silent = Silent(alone=np.full(m, share), correlation=np.full(m, c))
    period = growth.period(
        unannounced=Unannounced(by_law=BY_LAW, by_fail_safe=BY_FAIL_SAFE),
        K=growth.K,
        correlation=c,
        silent=None if alone is None else silent,
    )

    dx = belief.covariance.basis.T @ xi[: growth.s]
    hover = FailSafe(run.system, run.hover.u, run.hover.x[None], gains=run.run.settings.alone_gains)
    K_alone = padded(np.vstack([hover.gain(uav) for uav in range(run.system.N)]), len(dx))
    by_law = share * (K_alone @ dx) + (1.0 - share) * (1.0 - c) * (growth.K @ dx)
    answers = np.select([BY_LAW, BY_FAIL_SAFE], [by_law, growth.K @ dx])
    unshared = (1.0 - share) * (1.0 - c**2) ** 0.5 * np.where(BY_LAW, growth.K @ dx, 0.0)

    kept = np.ones(len(xi) - growth.s)
    if len(kept):
        first, change = ForceNoise().first(run.system), ForceNoise().change(run.system, PERIOD_S)
        kept = (1.0 - change.diagonal() / first**2) ** (share / 2.0)
    grown = np.concatenate([growth.slope(xi, answers), kept * xi[growth.s :]])
    by_others = np.concatenate([growth.slope(0.0 * xi, unshared), np.zeros(len(kept))])
    expected = np.outer(grown, grown) + np.outer(by_others, by_others)
    found = growth.after(xi, period) - growth.after(0.0 * xi, period)

    scale = np.maximum(np.sqrt(expected.diagonal()), growth.deviations)
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0.0, atol=SAME
    )
    np.testing.assert_allclose(
        found[growth.s :, growth.s :], expected[growth.s :, growth.s :], rtol=1e-6
    )


@pytest.mark.parametrize("settings", [(), (LAG, FORCES)], ids=["", "lag, forces"])
def test_noise_of_a_period(settings: Sequence[str]) -> None:
    """The level scales the model's errors where innovations tell it: after (63), (63b), (63c), (63e).

    They are 0.01 m/s^2 and rad/s^2 of acceleration, or the changes of forces, and beside these 0.001.
    Inputs that change act up to 30 ms late. UAVs alone answer to the noise of their sensors, and their
    integrals to gusts, 1.5 % of what a UAV carries.
    """
    growth, level, share = Growth(*settings), 0.3, 0.4
    run, N, m = growth.run, growth.run.system.N, growth.run.system.m
    none, size = np.zeros(len(growth.deviations)), len(growth.deviations)

    is_rate = [
        np.repeat([0.0, 1.0, 0.0, 1.0], 3),
        *[np.repeat([0.0, 1.0, 0.0, 1.0], UAV_BLOCKS)] * N,
    ]
    white = np.zeros((size, size))
    np.fill_diagonal(white, PERIOD_S**2 * np.append(np.concatenate(is_rate), none)[:size])
    scaled, beside = 0.01**2 * white, 0.0 * white
    if FORCES in settings:
        scaled, beside = 0.0 * white, 0.001**2 * white
        scaled[-COUNT:, -COUNT:] = ForceNoise().change(run.system, PERIOD_S)

    def effect(columns: Sequence[Array]) -> Array:
        """Return the covariance of independent changes of the coordinates of the state."""
        noise = np.zeros((size, size))
        noise[: growth.s, : growth.s] = sum(np.outer(one, one) for one in columns)
        return noise

    hover = FailSafe(run.system, run.hover.u, run.hover.x[None], gains=run.run.settings.alone_gains)
    by_sensors = np.vstack([hover.law(uav).by_sensors() for uav in range(N)])
    of_inputs = np.sqrt(by_sensors**2 @ np.repeat(run.sensors.noise, 3) ** 2)
    alone = [growth.slope(none, du) for du in np.diag(share * of_inputs)[BY_LAW]]
    if FORCES in settings:
        gusts = np.zeros((2, 1 + N, 3))
        for uav in (1, 3):
            lasts = (2.0 * hover.law(uav).follows_s / PERIOD_S) ** 0.5
            gusts[:, 1 + uav, :2] = np.eye(2) * 0.015 * lasts * share * run.hover.u[4 * uav]
        alone += [growth.slope(none, np.zeros(m), gust.reshape(-1)) for gust in gusts]
    changed = growth.u - growth.belief.u
    late = [growth.slope(none, du) for du in np.diag(0.03 / PERIOD_S * changed)]

    told = np.zeros(m, dtype=bool)
    silent = Silent(alone=np.full(m, share), correlation=np.full(m, 0.6))
    law = Unannounced(by_law=BY_LAW, by_fail_safe=told)
    none_unannounced = Unannounced(by_law=told, by_fail_safe=told)
    on_fail_safe = Unannounced(by_law=told, by_fail_safe=BY_FAIL_SAFE)
    still, exact = growth.belief.u, np.zeros((size, size))
    for unannounced, who, u, factor, approximate in [
        (none_unannounced, None, still, level, exact),
        (none_unannounced, None, growth.u, level, effect(late)),
        (law, None, still, level, exact),
        (law, replace(silent, alone=np.zeros(m)), still, level, exact),
        (law, silent, still, 1.0, effect(alone)),
        (on_fail_safe, None, still, 1.0, exact),
    ]:
        K = growth.K if unannounced.any() else None
        period = growth.period(unannounced=unannounced, K=K, u=u, correlation=0.6, silent=who)
        found = growth.after(none, period, level)
        Q = factor * scaled + beside + approximate
        if approximate is exact:
            np.testing.assert_allclose(found, Q, rtol=1e-9, atol=1e-18)
            continue
        scale = np.sqrt(Q.diagonal()) + 1e-3 * growth.deviations
        by_scale = np.outer(scale, scale)
        np.testing.assert_allclose(found / by_scale, Q / by_scale, rtol=0.0, atol=SAME_VARIANCE)


def test_lagging_motors_count_as_they_are() -> None:
    """Measurements are predicted with actual inputs, and a covariance is about the end of its period, (62)."""
    growth = Growth(LAG)
    team, belief, period = growth.team, growth.belief, growth.period()
    n = growth.run.system.n
    situation = team.growth.situation(belief, growth.run.model, growth.u, None)
    np.testing.assert_array_equal(situation.actual, belief.x[n:])
    np.testing.assert_array_equal(
        team.growth.after(belief, period).basis.T, team.manifold.basis(period.end).T
    )
