"""The control law of a team about its hover: regulator and steady state under forces."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from transport.model.arrays import Array, padded
from transport.model.digests_and_shared_results import SharedResults, digest
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import Hover, hover_after_failures
from transport.model.state import input_slice
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam, Regulator, TeamFailures, regulator
from transport.mpc.law.preview import at_rest
from transport.mpc.law.steady_state import SteadyState, target
from transport.mpc.program.feedback_law import FeedbackError
from transport.mpc.program.stage_cost import Cost
from transport.mpc.program.user_expressions import UserCosts
from transport.mpc.settings_period_horizon_weights import ControllerSettings


class Crew:
    """The whole team and the settings of its controllers: what all control laws of a run share."""

    def __init__(self, model: Model, hover: Hover, settings: ControllerSettings) -> None:
        self.model = model
        self.hover = hover
        self.settings = settings
        terms = (*settings.cost, *settings.weights.terms(model.system.N))
        self.user_costs = UserCosts(terms, model.system)

    @property
    def key(self) -> bytes:
        """Digest of the numbers that control laws follow from.

        Gains of UAVs alone count where a fail-safe has them.
        """
        kind = type(self.model).__qualname__
        settings = self.settings.model_copy(update={"alone": None})
        return digest(kind, self.model.system, self.hover, repr(settings))

    @property
    def needs_regulator(self) -> bool:
        """True if controllers with these settings use a shared control law or its cost-to-go."""
        return self.settings.prediction == "closed_loop" or self.settings.terminal == "riccati"


@dataclass(frozen=True, kw_only=True, eq=False)
class HoverLaw:
    """The control law of a team about the hover that its UAVs with motors can hold."""

    key: bytes  # digest of what the law follows from
    crew: Crew
    hovering: HoveringTeam
    regulator: Regulator | None  # None if the settings need none

    @cached_property
    def target(self) -> SteadyState:
        """Steady state under external forces. Source: docs/equations.md (40)."""
        return target(self.hovering)

    @cached_property
    def forced(self) -> tuple[Array, Array]:
        """Feedforward, (m, F), and slope of the cost-to-go, (n, F), per newton.

        They answer to outputs that the target misses: p = A_closed' p + T'C'QC M_x.
        Source: docs/equations.md (40a).
        """
        regulator = self.regulator
        if regulator is None:
            raise FeedbackError("expected a shared control law, got none")
        hovering = self.hovering
        M_x = self.target.M_x
        C = hovering.model.linearise(hovering.hover.x, hovering.hover.u).C
        terms = self.crew.user_costs.about(hovering.hover.x)
        missed = C.T @ (hovering.cost.Q[:, None] * (C @ M_x)) + terms.T @ (terms @ M_x)

        q = regulator.T.T @ padded(missed.T, len(regulator.T)).T
        p = at_rest(regulator, q)
        feedforward = np.zeros_like(self.target.M_u)
        feedforward[regulator.controlled] = regulator.preview_gain @ p
        return feedforward, regulator.T @ p


# Riccati solutions: in a process with several agents all have the same.
_HOVER_LAWS: SharedResults[HoverLaw] = SharedResults()


def hover_law(crew: Crew, fail_safe: FailSafe, team: TeamFailures) -> HoverLaw:
    """Return the law of a team about hover; UAVs without agents follow the fail-safe, (45), (50).

    Raises: ParameterError: the team has no hover. FeedbackError: no gain stabilises it.
    """
    # UAVs with an agent use none.
    answer = (fail_safe.follows, repr(fail_safe.gains)) if team.gone else None
    key = digest(crew.key, answer, team)
    return _HOVER_LAWS.get(key, lambda: _hover_law(key, crew, fail_safe, team))


def _hover_law(key: bytes, crew: Crew, fail_safe: FailSafe, team: TeamFailures) -> HoverLaw:
    """Return the law of a team about hover, anew."""
    hovering = _hovering(crew, fail_safe, team)
    law = None
    if crew.needs_regulator:
        terms = crew.user_costs.about(hovering.hover.x)
        settings = crew.settings
        law = regulator(hovering, settings.sampling_period_s, settings.motor_lag_s, terms)
    return HoverLaw(key=key, crew=crew, hovering=hovering, regulator=law)


def _hovering(crew: Crew, fail_safe: FailSafe, team: TeamFailures) -> HoveringTeam:
    """Return a team about its hover, with the thrusts of UAVs on the fail-safe as they are."""
    # A UAV without motors has no fail-safe.
    uncontrolled = {uav: fail_safe.gain(uav) for uav in team.gone - team.off}
    system = crew.model.system
    model = crew.model
    hover = crew.hover
    if team.off:
        thrusts = {}
        for uav in uncontrolled:
            thrusts[uav] = float(fail_safe.u_hover[input_slice(uav)][0])
        model = Model(system, team.off, team.released)
        hover = hover_after_failures(system, team.off, team.released, thrusts)
    cost = Cost(crew.settings.weights, system, hover, team.off, team.released)
    return HoveringTeam(model=model, hover=hover, cost=cost, team=team, uncontrolled=uncontrolled)
