"""How the law of a team is formed: for a death, a failure, a return, or a change of the reference.

The reference as all teams follow it (`Followed`), the law without its regulator along a flat
reference (`law_before_tracking`), that regulator by parts (`recursion_of`), and the law after a
further target (`law_after_change`). Agents of one process share all results by value.
"""

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from transport.model.arrays import Array, continued, padded
from transport.model.digests_and_shared_results import SharedResults, digest
from transport.model.path import flat_reference as flat
from transport.model.path.flat_reference import Track
from transport.model.physics.parameters import ParameterError
from transport.model.state import input_indices
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.alone.undisturbed_motion import ControlledTeam, UndisturbedMotion
from transport.mpc.law.hover_law import Crew, HoverLaw, hover_law
from transport.mpc.law.infinite_horizon_lqr import Regulator, TeamFailures
from transport.mpc.law.preview import Preview, only_known, preview
from transport.mpc.law.team_law import TeamLaw
from transport.mpc.law.tracking_lqr import Recursion, Tracker
from transport.mpc.program.feedback_law import FeedbackError
from transport.mpc.reference import KEPT, ReferenceChange, Sampled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Followed:
    """The reference that the laws of all teams follow, from its newest change on.

    It is made in two steps, as the fail-safe follows the motion that a law gives, and that law needs
    one: first with a fail-safe that follows the reference, then with one that follows the motion.
    """

    fail_safe: FailSafe  # of the whole team, which follows its undisturbed motion
    ahead: ReferenceChange | None  # the part whose preview is computed; None without reference
    preview_before: Preview | None = None  # the response to the reference before that part

    @staticmethod
    def of(crew: Crew, reference: Sampled | None) -> "Followed":
        """Return the whole of a reference; without one the team hovers."""
        if reference is None:
            return Followed(fail_safe=_fail_safe(crew, crew.hover.x[None], None), ahead=None)
        whole = ReferenceChange(first=0, X=reference.X, track=reference.track)
        fail_safe = _fail_safe(crew, reference.X, reference.track)
        followed = Followed(fail_safe=fail_safe, ahead=whole)
        return followed.with_motion(crew, reference, None)

    @staticmethod
    def after(
        crew: Crew, reference: Sampled, change: ReferenceChange, whole: TeamLaw
    ) -> "Followed":
        """Return a reference from its newest change on; before, the whole team's law stays."""
        fail_safe = _fail_safe(crew, reference.X, reference.track)
        followed = Followed(fail_safe=fail_safe, ahead=change, preview_before=whole.preview)
        return followed.with_motion(crew, reference, whole.fail_safe.motion)

    def with_motion(
        self, crew: Crew, reference: Sampled, before: UndisturbedMotion | None
    ) -> "Followed":
        """Return the same with the undisturbed motion of the whole team along a hover reference.

        The law whose fail-safe follows the reference gives the motion; the fail-safe of the result
        follows that motion. The motion before goes on to the newest change of the reference.
        Source: docs/equations.md (31f).
        """
        is_known = crew.settings.prediction == "closed_loop" and not crew.settings.motor_lag_s
        if not self.fail_safe.follows or reference.track is not None or not is_known:
            return self

        law = law_before_tracking(crew, self, TeamFailures())
        by_before = None if before is None else before.key
        key = digest(law.about_hover.key, reference.key, by_before)
        first = 0 if before is None or reference.change is None else reference.change.first
        motion = _MOTIONS.get(
            key, lambda: undisturbed(law, reference, first, before=before, key=key)
        )
        return replace(self, fail_safe=_fail_safe(crew, reference.X, None, motion))


def undisturbed(
    law: TeamLaw,
    reference: Sampled,
    first: int,
    *,
    before: UndisturbedMotion | None = None,
    key: bytes = b"",
) -> UndisturbedMotion:
    """Return the motion that the team of a law takes along a hover reference, undisturbed.

    The motion before goes on to the `first` instant; without one it begins there on the reference.
    """
    X_ref = reference.X
    settings = law.about_hover.crew.settings
    model = law.about_hover.hovering.model
    lower, upper = settings.lower(model.system.N), settings.upper(model.system.N)

    def inputs(x: Array, instant: int) -> Array:
        u = law.inputs(x, X_ref[min(instant, len(X_ref) - 1)], None, instant)
        if u is None:
            raise FeedbackError("expected a shared control law, got open-loop prediction")
        return np.clip(u, lower, upper)

    team = ControlledTeam(model=model, inputs=inputs, period_s=settings.sampling_period_s)
    return UndisturbedMotion(team, X_ref, before=before, first=first, key=key)


def law_before_tracking(crew: Crew, followed: Followed, team: TeamFailures) -> TeamLaw:
    """Return the law of a team without the regulator along a flat reference, which takes longest.

    If the remaining UAVs cannot stabilise the payload, the law is that of the team without the
    losses of agents, else without the failures, else of the whole team: equations.md (45), (50),
    (51).
    Raises: FeedbackError: the settings need a regulator, and none stabilises the whole team.
    """
    fewer = [team, TeamFailures(off=team.off, released=team.released), TeamFailures(gone=team.gone)]
    for possible in fewer if any(team) else []:
        with contextlib.suppress(FeedbackError, ParameterError):
            return _law_of(crew, followed, possible)
    return _law_of(crew, followed, TeamFailures())


def _law_of(crew: Crew, followed: Followed, team: TeamFailures) -> TeamLaw:
    """Return the law of exactly this team, without the regulator along a flat reference."""
    fail_safe = followed.fail_safe
    if team.off:
        key = digest(crew.key, fail_safe.key, team)
        fail_safe = _FAIL_SAFES.get(
            key, lambda: followed.fail_safe.of_team(team.off, team.released)
        )
    about_hover = hover_law(crew, fail_safe, team)
    response = _preview(about_hover, followed, fail_safe.motion)
    return TeamLaw(about_hover=about_hover, fail_safe=fail_safe, preview=response)


def recursion_of(law: TeamLaw, before: Tracker | None, since: int) -> Recursion:
    """Return the recursion to the regulator along the track of a law, shared by all agents.

    Before the instant `since` the regulator `before` of another team holds.
    """
    track = law.track
    if track is None:
        raise FeedbackError("expected a flat reference, got one of hover")
    key = digest(law.about_hover.key, track.key, since, None if before is None else before.key)
    return _RECURSIONS.get(
        key, lambda: Recursion(law.about_hover, law.fail_safe, track, key, before, since)
    )


def law_after_change(law: TeamLaw, followed: Followed) -> TeamLaw:
    """Return the law of the same team after its reference has changed.

    Gains and preview before the change stay as they were.
    """
    crew = law.about_hover.crew
    changed = _law_of(crew, followed, law.team)
    part = None if followed.ahead is None else followed.ahead.track
    if part is None or law.regulator is None or law.tracker is None:
        return changed

    about_hover = law.about_hover
    released = about_hover.hovering.team.released
    if released:
        hovering = about_hover.hovering
        system = hovering.model.system
        hover = hovering.hover
        part = flat.track(system, hover, part.paths, part.first, released)
    before = law.tracker
    key = digest(about_hover.key, part.key, before.key)

    def continued_tracker() -> Tracker:
        recursion = Recursion(about_hover, changed.fail_safe, part, key, None, part.first)
        return continued(before, recursion.result(), KEPT)

    return replace(changed, tracker=_TRACKERS.get(key, continued_tracker))


def _fail_safe(
    crew: Crew, X: Array, track: Track | None, motion: UndisturbedMotion | None = None
) -> FailSafe:
    """Return the fail-safe of the whole team, which follows states or a motion, or keeps level."""
    follows = crew.settings.fail_safe == "follow"
    gains = crew.settings.alone_gains
    X_ref = X if follows else None
    return FailSafe(crew.model.system, crew.hover.u, X_ref, track, motion, gains)


def _preview(law: HoverLaw, followed: Followed, motion: UndisturbedMotion | None) -> Preview | None:
    """Return the response to a hover reference ahead, if the settings ask for it: (36b), (36c).

    UAVs without an agent follow a motion, or the reference. What they do along a motion is part of
    the law without preview as well.
    """
    ahead = followed.ahead
    if law.regulator is None or ahead is None or ahead.track is not None:
        return None
    regulator = law.regulator
    is_previewed = law.crew.settings.preview
    followed_motion = motion if law.hovering.uncontrolled else None
    if not is_previewed and followed_motion is None:
        return None
    before = followed.preview_before

    def computed() -> Preview:
        X = ahead.X
        on_reference = None
        if followed_motion is not None:
            # The motion comes to rest after the reference.
            missing = max(0, followed_motion.last + 1 - ahead.first - len(X))
            X = np.concatenate([X, np.repeat(X[-1:], missing, axis=0)])
            on_reference = _inputs_on_reference(law, followed_motion, X, ahead.first)

        if is_previewed or on_reference is None:
            response = _response(law, regulator, X, on_reference, ahead.first)
        else:
            response = only_known(regulator, on_reference, ahead.first)
        return response if before is None else continued(before, response, KEPT)

    # All that the response follows from: the preview setting and the weights are in the law's key.
    by_before = None if before is None else (before.feedforward, before.slope, before.first)
    by_motion = None if followed_motion is None else followed_motion.key
    return _PREVIEWS.get(digest(law.key, ahead.X, ahead.first, by_before, by_motion), computed)


def _response(
    law: HoverLaw, regulator: Regulator, X: Array, on_reference: Array | None, first: int
) -> Preview:
    """Return the optimal answer to reference states, (K, n), from the `first` instant on: (36b)."""
    # On the reference, the output error is zero; the user's terms are not.
    costs = law.crew.user_costs
    states = len(regulator.T)
    values = np.array([costs.at(x)[0] for x in X])
    pull = (np.sqrt(costs.weights) * values) @ padded(costs.about(law.hovering.hover.x), states)
    # The actual inputs of the reference are those of hover: their deviation is zero.
    return preview(regulator, padded(X, states), pull, on_reference, first)


def _inputs_on_reference(
    law: HoverLaw, motion: UndisturbedMotion, X_ref: Array, first: int
) -> Array:
    """Return the inputs of UAVs without an agent on the reference, from those at hover, (K, m_u).

    v(k) = K_u (x_ref(k) - x*(k)) + u*_u(k) - u_hov,u, zero once the motion is at rest.
    Source: docs/equations.md (45a).
    """
    hovering = law.hovering
    uncontrolled = input_indices(sorted(hovering.uncontrolled))
    K = np.concatenate([hovering.uncontrolled[uav] for uav in sorted(hovering.uncontrolled)])
    along = motion.over(first, len(X_ref))
    X = np.array([instant.x for instant in along])
    U = np.array([instant.u for instant in along])
    v: Array = (X_ref - X) @ K.T + (U - hovering.hover.u)[:, uncontrolled]
    v[max(0, motion.last - first) :] = 0.0
    return v


_FAIL_SAFES: SharedResults[FailSafe] = SharedResults()
_MOTIONS: SharedResults[UndisturbedMotion] = SharedResults()
_PREVIEWS: SharedResults[Preview] = SharedResults()
_RECURSIONS: SharedResults[Recursion] = SharedResults()
_TRACKERS: SharedResults[Tracker] = SharedResults()
