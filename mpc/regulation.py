"""The shared control law of a team.

Its regulator, preview and target, for the UAVs that have agents.
"""

import contextlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from transport.model import flat
from transport.model.arrays import Array, continued, padded, rows
from transport.model.flat import Track
from transport.model.hover import Hover, failed_hover
from transport.model.linearisation import Model
from transport.model.parameters import ParameterError
from transport.model.state import input_slice
from transport.mpc import feedback
from transport.mpc.cost import Cost
from transport.mpc.expressions import UserCosts
from transport.mpc.fail_safe import FailSafe
from transport.mpc.feedback import FeedbackError, FeedbackLaw, Preview, Regulator, Target, at_rest
from transport.mpc.settings import ControllerSettings
from transport.mpc.tracking import Recursion, Tracker

T = TypeVar("T")

# Instants before a change of the reference for which its law is kept: more than estimators look
# back.
KEPT = 128
# Results by model, team and identities of what else they follow from, which are kept beside them:
# the newest ones.
_MOST_FOUND = 64
_FOUND: WeakKeyDictionary[Model, dict[tuple[Any, ...], tuple[Any, tuple[object, ...]]]] = (
    WeakKeyDictionary()
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CostToGo:
    """The cost after the horizon as a function of the last state.

    |root (error + dx)|^2 + 2 slope' dx + constant.
    """

    root: Array  # square root of the Riccati solution, (rank, n)
    error: Array  # x0 - x_ref at step N_p, x_ref shifted by external forces, (n,)
    slope: Array  # effect of reference and forces, (n,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ahead:
    """Reference from an instant on, until it is at rest: another than before."""

    first: int  # the instant
    X_ref: Array  # reference states from then on, (L, n); the last one is held
    track: Track | None  # with a flat reference, that at the same instants


class Team(NamedTuple):
    """UAVs, 0-based, without an agent, without motors, and of these the released ones."""

    gone: frozenset[int]
    off: frozenset[int]
    released: frozenset[int]


class Regulation:
    """The shared control law and cost-to-go of one maneuver, for the UAVs that have agents.

    The reference, X_ref, (K, n), for the preview, or a flat track, is that at instants 0..K-1; the
    last one is held.
    Raises: FeedbackError: the settings need a regulator and none stabilises the team.
    """

    def __init__(
        self, model: Model, hover: Hover, settings: ControllerSettings, X_ref: Array | None = None,
        track: Track | None = None,
    ) -> None:  # fmt: skip
        self._whole, self._whole_hover, self._settings = model, hover, settings
        terms = (*settings.cost, *settings.weights.terms(model.system.N))
        self.user_costs = UserCosts(terms, model.system)  # the user's terms of the cost
        followed = (
            None if settings.fail_safe == "level" else hover.x[None] if X_ref is None else X_ref
        )
        self._whole_fail_safe = FailSafe(model.system, hover.u, followed, track)
        self._whole_track = track
        self._X_ref = X_ref if settings.preview and track is None else None
        self._follows_from = (hover, settings, X_ref, track)
        self._ahead: tuple[
            Ahead, ...
        ] = ()  # the newest change of the reference, and the preview before it
        self._preview_before: Preview | None = None
        self._preview: Preview | None = None
        self.regulator: Regulator | None = None  # None if the settings need none
        self._tracker: Tracker | None = None
        self._recursion: Recursion | None = None  # that makes the next one
        self.form((), (), ())

    @property
    def target(self) -> Target:
        """Steady state under external forces."""
        failed = self._team.off, self._team.released
        arguments = self._model, self.hover, self.cost, self._uncontrolled, *failed
        return self._shared("target", lambda: feedback.target(*arguments))

    def form(
        self,
        gone: Collection[int],
        off: Collection[int],
        released: Collection[int],
        *,
        since: int | None = None,
    ) -> None:
        """Set the `Team`: equations.md (45), (50), (51).

        Along a reference, if the present instant is given, `advance` completes the law. If the
        remaining UAVs cannot stabilise the team, the regulator ignores the lost agents, else the
        failures, else both.
        """
        none, team = frozenset[int](), Team(frozenset(gone), frozenset(off), frozenset(released))
        for smaller in (
            (team, team._replace(gone=none), Team(team.gone, none, none)) if any(team) else ()
        ):
            with contextlib.suppress(FeedbackError, ParameterError):
                return self._form(smaller, since)
        return self._form(Team(none, none, none), since)

    def advance(self, instant: int) -> bool:
        """Work on the law of a new team at an instant.

        Return whether it holds from this instant on, in all agents.
        """
        if self._recursion is None:
            return False
        if instant < self._recursion.ready:
            self._recursion.advance(instant)
            return False
        self._tracker, self._recursion = self._recursion.result(), None
        return True

    def head(self, X_ref: Array, ahead: Ahead) -> bool:
        """Follow another reference, of states X_ref, (K, n), from the present instant on.

        Returns: as `advance`.
        """
        completed = self._recursion is not None and self.advance(self._recursion.ready)
        self._ahead, self._preview_before = (ahead,), self._preview
        self._X_ref = None if self._X_ref is None else ahead.X_ref
        if self._whole_track is not None and ahead.track is not None:
            self._whole_track = continued(self._whole_track, ahead.track, KEPT)
        self._whole_fail_safe = self._whole_fail_safe.following(X_ref, self._whole_track)
        self._set_track()
        found = self.regulator
        if found is not None and ahead.track is not None and self._tracker is not None:
            track, released = ahead.track, self._team.released
            if released:
                track = flat.track(
                    self._model.system, self.hover, track.paths, track.first, released
                )
            new = self._shared(
                "ahead", lambda: self._recursion_along(track, found, None, ahead.first).result()
            )
            self._tracker = continued(self._tracker, new, KEPT)
        if found is not None:
            self._foresee(found)
        return completed

    def _form(self, team: Team, since: int | None) -> None:
        """Set the team. Raises: ParameterError, FeedbackError: there is no hover, or no regulator."""
        self._team, (gone, off, released) = team, team
        self._set_track()
        # A UAV without motors has no fail-safe.
        self._uncontrolled = {uav: self.fail_safe.gain(uav) for uav in gone - off}
        self._model, self.hover = self._whole, self._whole_hover
        if off:
            system, u = self._whole.system, self.fail_safe.u_hover
            held = {uav: float(u[input_slice(uav)][0]) for uav in self._uncontrolled}
            self._model = Model(system, off, released)
            self.hover = failed_hover(system, off, released, held)
        self.cost = Cost(self._settings.weights, self._whole.system, self.hover, off, released)
        if self._settings.prediction == "closed_loop" or self._settings.terminal == "riccati":
            self._regulate(since)

    def _set_track(self) -> None:
        self._track, self.fail_safe = self._whole_track, self._whole_fail_safe
        if self._team.off:
            failed, whole = self._team[1:], self._whole_fail_safe
            self.fail_safe = self._shared("fail-safe", lambda: whole.of_team(*failed))
            self._track = self.fail_safe.track

    def law(
        self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0
    ) -> FeedbackLaw | None:
        """Return the shared control law over the horizon.

        None with open-loop prediction: equations.md (35), (40).

        x0 is the state at instant `start`, (n,) or (n + m,); references, (N_p, n), corrections,
        (N_p, m), forces.
        """
        if self.regulator is None or self._settings.prediction != "closed_loop":
            return None
        if self._tracker is not None and self._track is not None:
            track, steps = self._track, len(x_ref)  # (70), (73)
            gains, where = (
                self._tracker.over(start, steps),
                rows(start - track.first, steps, len(track.X)),
            )
            u_rest, error = track.U[where], x0 - track.X[where]
            if forces is not None:
                X_forces, U_forces = track.by_forces(where)
                u_rest = u_rest + U_forces[..., : len(forces)] @ forces
                error = error - X_forces[..., : len(forces)] @ forces
            K, feedforward = (
                np.array([getattr(at, name) for at in gains]) for name in ("K", "feedforward")
            )
            return FeedbackLaw(
                K=K, u_rest=u_rest, error=error, feedforward=feedforward, c=c, along=gains
            )
        u_rest, error = self.hover.u, self._error(x0, x_ref)
        feedforward = self.feedforward(start, len(x_ref))
        if forces is not None:
            forces = self._model.at_rest(forces)
            u_rest, error = u_rest + self.target.M_u @ forces, error - self._shift(forces)
            feedforward = feedforward + self._forced(self.regulator)[0] @ forces
        return FeedbackLaw(
            K=self.regulator.K, u_rest=u_rest, error=error, feedforward=feedforward, c=c
        )

    @property
    def version(self) -> object:
        """The same object as long as the control law is the same."""
        return self.regulator if self._tracker is None else self._tracker

    def inputs(self, x: Array, x_ref: Array, forces: Array | None, instant: int) -> Array | None:
        """Return the inputs by `law` at one instant without corrections, (m,), or None with open-loop prediction."""
        law = self.law(x, x_ref[None], np.zeros((1, 0)), forces, instant)
        return None if law is None else law.uncorrected[0]

    def gain(self, instant: int) -> Array:
        """Return the derivative of `inputs` at an instant by the state, (m, n), with motor lag (m, n + m)."""
        if self._tracker is not None:
            return self._tracker.over(instant, 1)[0].K
        if self.regulator is None:
            raise FeedbackError("expected a shared control law, got open-loop prediction")
        return self.regulator.K

    def cost_to_go(
        self, x0: Array, x_ref: Array, forces: Array | None = None, instant: int = 0
    ) -> CostToGo | None:
        """Return the cost after the horizon, (36d), if any.

        Reference, (n,), and instant are those of step N_p.
        """
        if (
            self.regulator is None
            or self._settings.terminal != "riccati"
            or self._track is not None
        ):
            return None
        error, slope = self._error(x0, x_ref), np.zeros_like(x0)
        if self._preview is not None:
            slope = self._preview.slope[
                rows(instant - self._preview.first, 1, len(self._preview.slope))
            ][0]
        if forces is not None:
            forces = self._model.at_rest(forces)
            error = error - self._shift(forces)
            slope = slope + self._forced(self.regulator)[1] @ forces
        return CostToGo(root=self.regulator.root, error=error, slope=slope)

    def feedforward(self, start: int, steps: int) -> Array:
        """Return the response to the reference ahead from instant `start` on, (steps, m).

        Zero without preview.
        """
        if self._preview is None:
            return np.zeros((steps, self._model.system.m))
        return self._preview.feedforward[
            rows(start - self._preview.first, steps, len(self._preview.slope))
        ]

    def _error(self, x0: Array, x_ref: Array) -> Array:
        """Return the deviation of a state from reference states, (..., n).

        Actual inputs deviate from hover.
        """
        if len(x0) > x_ref.shape[-1]:
            actual = np.broadcast_to(self.hover.u, (*x_ref.shape[:-1], len(self.hover.u)))
            x_ref = np.concatenate([x_ref, actual], axis=-1)
        return x0 - x_ref

    def _shift(self, forces: Array) -> Array:
        """Return the deviation of the target from hover under forces, (n,).

        In it the actual inputs are the command.
        """
        shift: Array = self.target.M_x @ forces
        return (
            np.concatenate([shift, self.target.M_u @ forces])
            if self._settings.motor_lag_s
            else shift
        )

    def _regulate(self, since: int | None) -> None:
        further, failed, settings = (
            self.user_costs.about(self.hover.x),
            self._team[1:],
            self._settings,
        )
        about = (
            self._model,
            self.hover,
            self.cost,
            settings.sampling_period_s,
            self._uncontrolled,
            further,
            *failed,
        )
        found = self._shared("regulator", lambda: feedback.regulator(*about, settings.motor_lag_s))
        self.regulator = found
        if self._track is not None:
            track, before, self._recursion = (
                self._track,
                None if since is None else self._tracker,
                None,
            )
            begin = track.first if since is None else since
            making = self._shared(
                "tracker", lambda: self._recursion_along(track, found, before, begin)
            )
            if since is None or since >= making.ready:
                self._tracker = making.result()
            else:
                self._tracker, self._recursion = (
                    making.meanwhile(self._team.off, settings.horizon),
                    making,
                )
        self._foresee(found)

    def _recursion_along(
        self, track: Track, found: Regulator, before: Tracker | None, since: int
    ) -> Recursion:
        """Return the control law along a reference in the making.

        The last two arguments are those of `Recursion`.
        """
        fixed, period_s = (self._uncontrolled, self.fail_safe), self._settings.sampling_period_s
        return Recursion(
            self._model, track, found, self.cost, self.user_costs, period_s, *fixed, before, since
        )

    def _foresee(self, found: Regulator) -> None:
        """Compute the response to the reference from its newest change on.

        That before stays as it was.
        """
        if self._X_ref is not None:
            # On the reference, the output error is zero; the user's terms are not.
            states, further = len(found.T), self.user_costs.about(self.hover.x)
            on_reference = np.array([self.user_costs.at(x)[0] for x in self._X_ref])
            pull = (np.sqrt(self.user_costs.weights) * on_reference) @ padded(further, states)
            # The actual inputs of the reference are those of hover: their deviation from the last
            # ones is zero.
            X_ref, first = padded(self._X_ref, states), self._ahead[0].first if self._ahead else 0
            seen = self._shared("preview", lambda: feedback.preview(found, X_ref, pull, first))
            before = self._preview_before
            self._preview = seen if before is None else continued(before, seen, KEPT)

    def _shared(self, what: str, compute: Callable[[], T]) -> T:
        """Return a result for this team, computed by the first controller of the reference that needs it."""
        about_hover = what in ("regulator", "target", "forced")
        origin = self._follows_from if about_hover else (*self._follows_from, *self._ahead)
        found, key = _FOUND.setdefault(self._whole, {}), (what, *map(id, origin), *self._team)
        if key not in found:
            found[key] = compute(), origin
        result: T = found[key][0]
        while len(found) > _MOST_FOUND:
            del found[next(iter(found))]
        return result

    def _forced(self, regulator: Regulator) -> tuple[Array, Array]:
        """Return feedforward and slope of the cost-to-go per newton, where the target misses outputs: (40a)."""

        def forced() -> tuple[Array, Array]:
            C, target = self._model.linearise(self.hover.x, self.hover.u).C, self.target
            missed = C.T @ (self.cost.Q[:, None] * (C @ target.M_x))
            further = self.user_costs.about(self.hover.x)
            missed = missed + further.T @ (further @ target.M_x)
            p = at_rest(regulator, regulator.T.T @ padded(missed.T, len(regulator.T)).T)
            feedforward = np.zeros_like(target.M_u)
            feedforward[regulator.controlled] = regulator.preview_gain @ p
            return feedforward, regulator.T @ p

        return self._shared("forced", forced)
