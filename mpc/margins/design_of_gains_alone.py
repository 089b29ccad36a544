"""The control law of UAVs alone, designed for its team: the first of a family of gains that is stable with margins.

At the modes of the load on its rods (2 to 7 rad/s) the lag of an attitude loop turns the feedback of velocity,
by up to a quarter turn at 6 rad/s: what damps the load of a ring of equal UAVs feeds that of an irregular team.
No single choice serves all. Stiff gains come first, which hold the load best in wind; then those without the
feedback of swing, softer ones, and slower attitude loops for long periods and delays. Where none of them holds,
mostly with inputs that act a period of 0.1 s later, soft gains with the feedback of swing follow.
Source: docs/equations.md (31h).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import threadpoolctl

from transport.model import state
from transport.model.arrays import Array
from transport.model.digests_and_shared_results import digest
from transport.model.linear.discretisation import zero_order_hold
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System
from transport.mpc.alone.alone_law import AloneLaw
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.loop_of_uavs_alone import AloneLoop
from transport.mpc.margins.sampled_loop import GROWTH
from transport.mpc.settings_period_horizon_weights import AloneGains, ControllerSettings

# Slowest decay of all deviations about hover, 1/s: a little slower than the integral forgets.
DECAY_PER_S = 0.04
# Differences of the plant from the known one with which deviations still have to decay: a delay and a motor
# lag in addition; and, where a member of the family has that too, weaker motors and a heavier payload.
REQUIRED = (Mismatch(delay_s=0.02), Mismatch(lag_s=0.025))
WANTED = (Mismatch(gain=0.85), Mismatch(payload_mass=1.15))
# Shares of the law alone, of one UAV among others on the team's law and of all, that a hand-over passes.
_ONE_ALONE = (0.5, 1.0)
_ALL = (0.25, 0.5, 0.75)
# Attitude error, rad, for which the largest moments suffice.
_TURNED_RAD = 0.25

# Position, velocity, integral, swing.
_STIFFNESSES = (
    (6.0, 5.0, 2.5, 0.5),
    (6.0, 5.0, 2.5, 0.0),
    (4.5, 4.5, 1.7, 0.0),
    (3.0, 4.0, 1.0, 0.0),
    (2.0, 3.0, 0.6, 0.0),
    (1.0, 2.0, 0.3, 0.0),
)
# Frequency of the attitude loop on moments, rad/s, and largest gain from attitude to body rates, 1/s.
_ATTITUDES = ((6.0, 10.0), (9.0, 8.0), (12.0, 6.0), (7.5, 5.0), (6.75, 4.0))
# The same of gains for teams that no member of the family holds.
_SOFT_STIFFNESSES = ((2.0, 2.2, 0.3, 0.3), (0.9, 2.5, 0.15, 0.3), (0.7, 1.7, 0.15, 0.22))
_SOFT_ATTITUDES = ((6.75, 7.5), (5.5, 5.5), (4.75, 4.0), (8.0, 3.0))


def _family(
    stiffnesses: Sequence[tuple[float, float, float, float]],
    attitudes: Sequence[tuple[float, float]],
) -> tuple[AloneGains, ...]:
    """Return the gains of each stiffness with each attitude loop."""
    return tuple(
        AloneGains(
            position=position,
            velocity=velocity,
            integral=integral,
            swing=swing,
            attitude_rads=attitude_rads,
            rates=rates,
        )
        for (position, velocity, integral, swing), (attitude_rads, rates) in product(
            stiffnesses, attitudes
        )
    )


FAMILY = _family(_STIFFNESSES, _ATTITUDES)
SOFT_FAMILY = _family(_SOFT_STIFFNESSES, _SOFT_ATTITUDES)
_KEPT = 64  # designs of one process


@dataclass(frozen=True, slots=True, kw_only=True)
class AloneDesign:
    """Gains of UAVs alone for a team."""

    gains: AloneGains
    # Of the fastest growing deviation about hover, all UAVs alone, also after the releases of the run.
    growth_per_s: float
    # Whether deviations decay by `DECAY_PER_S`, and at all with `REQUIRED`, and in mixtures with the team's law.
    holds: bool

    @property
    def is_unstable(self) -> bool:
        """Whether deviations grow."""
        return self.growth_per_s > GROWTH

    def in_words(self) -> str:
        """Return the gains as text."""
        gains = self.gains
        turning = f"attitude {gains.attitude_rads:g} rad/s, rates {gains.rates:g}/s"
        return (
            f"position {gains.position:g}, velocity {gains.velocity:g}, "
            f"integral {gains.integral:g}, swing {gains.swing:g}, {turning}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamAlone:
    """A team whose UAVs may act alone, and what it flies by."""

    system: System
    settings: ControllerSettings
    next_tick: bool  # inputs act a period after their measurement
    # Sampling periods to the measurements of the vehicles' sensors; None: states are measured.
    ages: tuple[int, ...] | None
    # Of the team's law with which UAVs alone are mixed, (m, n); None without.
    team_gain: Array | None
    remaining: tuple[System, ...] = ()  # those that carry the payload after each release of the run

    def loop(self, gains: AloneGains, system: System | None = None) -> AloneLoop:
        """Return the loop of all UAVs alone, of the whole team or of those remaining."""
        return AloneLoop(
            self.system if system is None else system,
            self.settings.sampling_period_s,
            next_tick=self.next_tick,
            gains=gains,
            ages=self.ages,
            known_lag_s=self.settings.motor_lag_s,
        )

    def design(self) -> AloneDesign:
        """Return the gains of the first member of the family that holds, once for equal values.

        Holding: as `AloneDesign.holds`, of which the first one that also has the margins `WANTED` is taken;
        of the soft family only if none of the stiff one holds. If none at all holds: of those whose deviations
        decay the one whose deviations grow the least with `REQUIRED`, else the one of the slowest growth.
        """
        numbers = (self.settings.sampling_period_s, self.settings.motor_lag_s, self.next_tick)
        limits = self.settings.upper(1)
        given = repr(self.settings.alone)
        teams = (self.system, *self.remaining)
        key = digest(teams, numbers, self.ages, limits, self.team_gain, given)
        if key not in _DESIGNS:
            while len(_DESIGNS) >= _KEPT:
                del _DESIGNS[next(iter(_DESIGNS))]
            # Several threads are slower than one with matrices of this size.
            with threadpoolctl.threadpool_limits(1):
                _DESIGNS[key] = self._designed()
        return _DESIGNS[key]

    def _designed(self) -> AloneDesign:
        """Return the design, anew, as `design` describes it; gains that are given are only judged."""
        given = self.settings.alone
        if given is not None:
            return self._judged(given, self._loops(given))[0]

        # If no member holds: the one of the lowest rank, by growth without mismatch, then with `REQUIRED`.
        best: AloneDesign | None = None
        best_rank = (math.inf, math.inf)
        for family in (FAMILY, SOFT_FAMILY):
            holding: AloneDesign | None = None  # the first that holds, without the margins `WANTED`
            for gains in self._possible(family):
                loops = self._loops(gains)
                design, with_required = self._judged(gains, loops)
                if design.holds and self._growth(loops, WANTED) < 0.0:
                    return design
                if design.holds and holding is None:
                    holding = design

                rank = (max(design.growth_per_s, GROWTH), with_required)
                if best is None or rank < best_rank:
                    best, best_rank = design, rank
            if holding is not None:
                return holding
        if best is None:
            raise ValueError("expected gains to choose from, got none")
        return best

    def _judged(self, gains: AloneGains, loops: Sequence[AloneLoop]) -> tuple[AloneDesign, float]:
        """Return the design of gains, and the largest growth with `REQUIRED`, 1/s; infinite if any grows without."""
        growth = self._growth(loops, (Mismatch(),))
        with_required = math.inf if growth > GROWTH else self._growth(loops, REQUIRED)
        decays = growth < -DECAY_PER_S and with_required < 0.0
        holds = decays and self._is_mixed(gains)
        return AloneDesign(gains=gains, growth_per_s=growth, holds=holds), with_required

    def _loops(self, gains: AloneGains) -> list[AloneLoop]:
        """Return the loops of the whole team and of those remaining after each release."""
        return [self.loop(gains, system) for system in (self.system, *self.remaining)]

    def _possible(self, family: Sequence[AloneGains]) -> Iterator[AloneGains]:
        """Yield the members that the moments allow, different for the inputs of the team; the first always."""
        system = self.system
        # Angular acceleration about x and y that every UAV can give, rad/s^2.
        moments_Nm = self.settings.upper(1)[1:3]
        given = [float((moments_Nm / np.diag(uav.inertia)[:2]).min()) for uav in system.uavs]
        least_rads2 = min(given)

        # By the gains that the inputs of the team use: the others make no difference.
        yielded = set()
        for number, gains in enumerate(family):
            turning = gains.rates if system.commands_rates else gains.attitude_rads
            used = (gains.position, gains.velocity, gains.integral, gains.swing, turning)
            is_allowed = system.commands_rates or turning**2 * _TURNED_RAD <= least_rads2
            if number == 0 or (is_allowed and used not in yielded):
                yielded.add(used)
                yield gains

    def _growth(self, loops: Sequence[AloneLoop], plants: Sequence[Mismatch]) -> float:
        """Return the largest growth of deviations with any of some plants, 1/s; lags are beyond the known one."""
        lag_s = self.settings.motor_lag_s
        actual = [replace(one, lag_s=lag_s + one.lag_s) for one in plants]
        return max(loop.growth(plant) for plant, loop in product(actual, loops))

    def _is_mixed(self, gains: AloneGains) -> bool:
        """Return whether no mixture with the team's law lets deviations grow, in a hand-over.

        One UAV alone, or in part, the others on the team's law; and all by the same share. Integrals are left
        out, and headings, which the team's law may leave free, are neutral.
        """
        if self.team_gain is None:
            return True
        system = self.system
        period_s = self.settings.sampling_period_s
        at_rest = hover(system)

        # The team about hover in coordinates xi = T' (x - x_hover):  xi(k + 1) = A xi(k) + B du(k).
        T = tangent(at_rest.x)
        discrete = zero_order_hold(Model(system).linearise(at_rest.x, at_rest.u), period_s)
        A = T.T @ discrete.A @ T
        B = T.T @ discrete.B

        # Gains in xi, (m, r): that of the team's law, and the rows of each UAV alone.
        thrusts_N = at_rest.u[:: state.INPUTS]
        laws = [AloneLaw(system, uav, float(thrusts_N[uav]), gains) for uav in range(system.N)]
        K_team = self.team_gain @ T
        K_alone = np.vstack([law.gain() for law in laws]) @ T

        # du = ((1 - s) K_team + s K_alone) xi, with the share s of each UAV that acts alone.
        closed_loops = []
        for shares in _mixtures(system.N):
            s = np.repeat(shares, state.INPUTS)[:, None]
            closed_loops.append(A + B @ ((1.0 - s) * K_team + s * K_alone))
        largest = float(np.abs(np.linalg.eigvals(np.array(closed_loops))).max())
        return math.log(largest) / period_s <= GROWTH


def _mixtures(N: int) -> list[Array]:
    """Return the shares by which UAVs act alone in a hand-over, (N,) each: one of them, or all alike."""
    one_alone = [share * one for one in np.eye(N) for share in _ONE_ALONE]
    return one_alone + [np.full(N, share) for share in _ALL]


# By digests of what they follow from.
_DESIGNS: dict[bytes, AloneDesign] = {}
