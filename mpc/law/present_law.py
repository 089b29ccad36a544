"""The present control law of a team: how it changes with the team and with the reference.

A hover reference is followed by gains about hover, with a preview of what is ahead. A flat one, a
`Track`, is followed by a regulator along it, the `Tracker`. A backward `Recursion` computes its
gains in parts while the team flies; until it is ready, a provisional law holds. The whole team is
the one without deaths and failures.
"""

from collections.abc import Collection
from dataclasses import replace

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import Track
from transport.model.physics.hover import Hover
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.law.hover_law import Crew
from transport.mpc.law.infinite_horizon_lqr import TeamFailures
from transport.mpc.law.reconfiguration import (
    Followed,
    law_after_change,
    law_before_tracking,
    recursion_of,
)
from transport.mpc.law.team_law import TeamLaw
from transport.mpc.law.tracking_lqr import Recursion
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.user_expressions import UserCosts
from transport.mpc.reference import ReferenceChange, Sampled
from transport.mpc.settings_period_horizon_weights import ControllerSettings


class WholeTeam:
    """The law of the team without deaths and failures.

    UAVs without plans follow the motion that this team would fly. Along a flat reference they follow
    the reference itself: no gains of this team are needed for that, and `law` has no `tracker`.

    Raises: FeedbackError: the settings need a regulator and none stabilises the team.
    """

    def __init__(self, crew: Crew, reference: Sampled | None) -> None:
        self._crew = crew
        self.followed = Followed.of(crew, reference)
        self.law = law_before_tracking(crew, self.followed, TeamFailures())

    def follow(self, reference: Sampled, change: ReferenceChange) -> None:
        """Follow a reference with a further target, from that target's instant on."""
        self.followed = Followed.after(self._crew, reference, change, self.law)
        self.law = law_before_tracking(self._crew, self.followed, TeamFailures())


class Regulation:
    """The law of one controller, `current`, which all agents change at the same instants.

    Raises: FeedbackError: the settings need a regulator and none stabilises the team.
    """

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        reference: Sampled | None = None,
    ) -> None:
        self.crew = Crew(model, hover, settings)
        self._whole = WholeTeam(self.crew, reference)
        self._followed = self._whole.followed
        # Recursions along the present reference, by team; one of them may still be advancing.
        self._recursions: dict[TeamFailures, Recursion] = {}
        self._advancing: Recursion | None = None
        self.current = self._law_of(TeamFailures(), None, None)

    def form(
        self,
        gone: Collection[int],
        off: Collection[int],
        released: Collection[int],
        *,
        since: int | None = None,
    ) -> None:
        """Change to the law of a `TeamFailures` of `gone`, `off` and `released`: equations.md (45), (50), (51).

        `since` is the present instant. With a flat reference a provisional law holds from then on,
        until `advance` returns true: the regulator along it takes several ticks to compute. Without
        `since` the final law is computed at once.
        """
        team = TeamFailures(frozenset(gone), frozenset(off), frozenset(released))
        self.current = self._law_of(team, self.current, since)

    def _law_of(self, team: TeamFailures, before: TeamLaw | None, since: int | None) -> TeamLaw:
        """Return the law of a team, with what holds until its recursion is ready."""
        law = law_before_tracking(self.crew, self._followed, team)
        self._advancing = None
        if law.regulator is None or law.track is None:
            return law

        recursion = self._recursion_of(law, law.track, before, since)
        if since is None or since >= recursion.ready:
            return replace(law, tracker=recursion.result())
        self._advancing = recursion
        meanwhile = recursion.meanwhile(law.team.off, self.crew.settings.horizon)
        return replace(law, tracker=meanwhile)

    def _recursion_of(
        self, law: TeamLaw, track: Track, before: TeamLaw | None, since: int | None
    ) -> Recursion:
        """Return the recursion of a team along the present reference.

        A team that was formed before goes on with its recursion, of which a part may be computed,
        also where another law held in between: gains follow backwards from the end of the
        reference, whatever held before them. `follow` forgets the recursions, which are along one
        reference.
        Otherwise the law before holds until the given instant; without one the gains are those
        along the whole reference, as an agent has them that starts in mid-run.
        """
        known = self._recursions.get(law.team)
        if known is not None:
            return known
        if since is None or before is None:
            recursion = recursion_of(law, None, track.first)
        else:
            recursion = recursion_of(law, before.tracker, since)
        self._recursions[law.team] = recursion
        return recursion

    def advance(self, instant: int) -> bool:
        """Continue the recursion of a new team at an instant.

        Return whether its result holds from this instant on, in all agents: false while it is under
        way, and where none is.
        """
        if self._advancing is None:
            return False
        if instant < self._advancing.ready:
            self._advancing.advance(instant)
            return False
        self.current = replace(self.current, tracker=self._advancing.result())
        self._advancing = None
        return True

    def follow(self, reference: Sampled) -> bool:
        """Follow a reference with a further target, from that target's instant on.

        A recursion that is under way is completed first. Return whether there was one: its result
        holds from now on, as where `advance` returns true.
        """
        if reference.change is None:
            return False
        completed = self._complete()
        self._whole.follow(reference, reference.change)
        # Before the target the present team keeps its own preview, not that of the whole team.
        self._followed = replace(self._whole.followed, preview_before=self.current.preview)
        self._recursions.clear()
        self.current = law_after_change(self.current, self._followed)
        return completed

    def _complete(self) -> bool:
        """Take the result of a recursion that is under way, computing the rest of it."""
        return self._advancing is not None and self.advance(self._advancing.ready)

    @property
    def whole(self) -> TeamLaw:
        """The law of the team without deaths and failures, without regulator along a flat path."""
        return self._whole.law

    @property
    def user_costs(self) -> UserCosts:
        """The user's terms of the cost."""
        return self.crew.user_costs

    @property
    def hover(self) -> Hover:
        """The equilibrium of the present team."""
        return self.current.hover

    @property
    def fail_safe(self) -> FailSafe:
        """The fail-safe of the present team."""
        return self.current.fail_safe

    def law(
        self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0
    ) -> FeedbackLaw | None:
        """Return the present law over a horizon, as `TeamLaw.over`."""
        return self.current.over(x0, x_ref, c, forces, start)

    def inputs(self, x: Array, x_ref: Array, forces: Array | None, instant: int) -> Array | None:
        """Return the inputs by the present law at one instant, as `TeamLaw.inputs`."""
        return self.current.inputs(x, x_ref, forces, instant)

    def gain(self, instant: int) -> Array:
        """Return the gain of the present law at an instant, as `TeamLaw.gain`."""
        return self.current.gain(instant)
