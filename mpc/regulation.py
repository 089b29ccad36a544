"""The shared control law of a team: its regulator, preview and target, for the UAVs that have agents."""

import contextlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from model import flat
from model.arrays import Array, padded
from model.failure import failed_hover, failed_model
from model.flat import Track
from model.hover import Hover
from model.linearisation import Model
from model.parameters import ParameterError
from model.state import input_slice
from mpc.cost import Cost, UserCosts
from mpc.fail_safe import FailSafe
from mpc.feedback import (
    FeedbackError,
    FeedbackLaw,
    Preview,
    Regulator,
    Target,
    at_rest,
    preview,
    regulator,
    target,
)
from mpc.settings import ControllerSettings
from mpc.tracking import Recursion, Tracker

T = TypeVar("T")

_NO_CORRECTIONS = np.zeros((1, 0))
# Regulators and previews by model and team: computed once for all controllers of a process. Keys have the identities of
# what else they follow from, which is kept beside the result.
_FOUND: WeakKeyDictionary[Model, dict[tuple[Any, ...], tuple[Any, tuple[object, ...]]]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True, kw_only=True)
class CostToGo:
    """The cost after the horizon as a function of the last state: |root (error + dx)|^2 + 2 slope' dx + constant.

    Attributes:
        root: Square root of the Riccati solution, (rank, n).
        error: x0 - x_ref at step N_p, x_ref shifted by external forces, (n,).
        slope: Effect of reference and forces, (n,).
    """

    root: Array
    error: Array
    slope: Array


class Regulation:
    """The shared control law and cost-to-go of one maneuver.

    Args:
        model: The system as the controller knows it.
        X_ref: Reference states at instants 0..K-1, (K, n), for the preview; the last one is held.
        track: A flat reference at these instants, which the control law follows instead.
    Raises: FeedbackError: the settings need a regulator and none stabilises the team.

    Attributes:
        hover, cost: Equilibrium and cost of the remaining team.
        user_costs: The user's terms of the cost.
        regulator: None if the settings need none.
    """

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        X_ref: Array | None = None,
        track: Track | None = None,
    ) -> None:
        self._whole, self._whole_hover = model, hover
        self._lag_s = settings.motor_lag_s
        terms = (*settings.cost, *settings.weights.terms(model.system.N))
        self._settings, self.user_costs = settings, UserCosts(terms, model)
        followed = None if settings.fail_safe == "level" else hover.x[None] if X_ref is None else X_ref
        self._fail_safe = FailSafe(model.system, hover.u, followed, None if track is None else track.U)
        self._track = self._whole_track = track
        previewed = settings.preview and track is None
        self._X_ref, self._follows_from = X_ref if previewed else None, (hover, settings, X_ref, track)
        # Values of the user's terms on the reference, (K, terms): no team changes them.
        self._on_reference = (
            None if self._X_ref is None else np.array([self.user_costs.at(x).value for x in self._X_ref])
        )
        self._preview: Preview | None = None
        self.regulator: Regulator | None = None
        self._tracker: Tracker | None = None
        self._recursion: Recursion | None = None  # that makes the next one
        self._target: Target | None = None
        self._by_forces: tuple[Array, Array] | None = None
        self._form(frozenset(), frozenset(), frozenset(), None)

    @property
    def target(self) -> Target:
        """Steady state under external forces; computed at the first use."""
        if self._target is None:
            self._target = target(self._model, self.hover, self.cost, self._uncontrolled, self._off, self._released)
        return self._target

    def form(
        self, gone: Collection[int], off: Collection[int], released: Collection[int], *, since: int | None = None
    ) -> None:
        """Set the UAVs, 0-based, without an agent, without motors, and of these those released from their rods.

        The shared control law depends on nothing else, so it is the same in all agents. UAVs without an agent follow
        the fail-safe. Along a reference, the law for a team not met before takes the work of several instants: if the
        present instant is given, `advance` completes it.
        If the remaining UAVs have no hover or cannot stabilise the team, the regulator ignores the lost agents, else
        the failures, else both. Source: docs/equations.md (40), (45), (50), (51).
        """
        none: frozenset[int] = frozenset()
        gone, off, released = frozenset(gone), frozenset(off), frozenset(released)
        for team in ((gone, off, released), (none, off, released), (gone, none, none)):
            with contextlib.suppress(FeedbackError, ParameterError):
                return self._form(*team, since)
        return self._form(none, none, none, since)

    def advance(self, instant: int) -> bool:
        """Work on the law of a new team at an instant; return whether that law holds from this instant on.

        This is the same instant for all agents.
        """
        if self._recursion is None:
            return False
        if instant < self._recursion.ready:
            self._recursion.advance(instant)
            return False
        self._tracker, self._recursion = self._recursion.result(), None
        return True

    def _form(self, gone: frozenset[int], off: frozenset[int], released: frozenset[int], since: int | None) -> None:
        """Set the team. Raises: ParameterError, FeedbackError: there is no hover, or no regulator."""
        self._team, self._off, self._released = (gone, off, released), off, released
        # A UAV without motors has no fail-safe.
        self._uncontrolled = {uav: self._fail_safe.gain(uav) for uav in gone - off}
        self._model, self.hover = self._whole, self._whole_hover
        if off:
            system, u = self._whole.system, self._whole_hover.u
            held = {uav: float(u[input_slice(uav)][0]) for uav in self._uncontrolled}
            self._model = failed_model(system, off, released)
            self.hover = failed_hover(system, off, released, held)
        if self._whole_track is not None:
            self._track = known = self._whole_track
            if released:
                self._track = self._shared(
                    "track", lambda: flat.track(self._model.system, self.hover, known.paths, released)
                )
        self.cost = Cost(self._settings.weights, self._whole.system, self.hover, off, released)
        self._target = self._by_forces = None
        if self._settings.prediction == "closed_loop" or self._settings.terminal == "riccati":
            self._regulate(since)

    def law(self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0) -> FeedbackLaw | None:
        """Return the shared control law over the horizon; None with open-loop prediction.

        Args:
            x0: State at the first step of the horizon, (n,); with motor lag [x, actual inputs], (n + m,).
            x_ref: Reference states at steps 0..N_p-1, (N_p, n).
            c: Announced corrections of all UAVs, (N_p, m).
            forces: Estimated external forces, inertial frame, N, and mass (`Model`); None without estimate.
            start: Instant of the first step.
        Source: docs/equations.md (35), (40).
        """
        if self.regulator is None or self._settings.prediction != "closed_loop":
            return None
        if self._tracker is not None and self._track is not None:
            return self._law_along(self._tracker, self._track, x0, c, forces, start, len(x_ref))
        u_rest, error = self.hover.u, self._error(x0, x_ref)
        feedforward = self.feedforward(start, len(x_ref))
        if forces is not None:
            forces = self._model.at_rest(forces)
            u_rest, error = u_rest + self.target.M_u @ forces, error - self._shift(forces)
            feedforward = feedforward + self._forced(self.regulator)[0] @ forces
        return FeedbackLaw(K=self.regulator.K, u_rest=u_rest, error=error, feedforward=feedforward, c=c)

    def _law_along(
        self, tracker: Tracker, track: Track, x0: Array, c: Array, forces: Array | None, start: int, steps: int
    ) -> FeedbackLaw:
        """Return the control law along the reference. Source: docs/equations.md (70), (73)."""
        at, where = _clamped(start, steps, len(tracker.K)), _clamped(start, steps, len(track.X))
        u_rest, error = track.U[where], x0 - track.X[where]
        if forces is not None:
            u_rest = u_rest + track.U_forces[where, :, : len(forces)] @ forces
            error = error - track.X_forces[where, :, : len(forces)] @ forces
        return FeedbackLaw(
            K=tracker.K[at],
            u_rest=u_rest,
            error=error,
            feedforward=tracker.feedforward[at],
            c=c,
            along=tracker.along.at(at),
        )

    @property
    def version(self) -> object:
        """The same object as long as the control law is the same."""
        return self.regulator if self._tracker is None else self._tracker

    def inputs(self, x: Array, x_ref: Array, forces: Array | None, instant: int) -> Array | None:
        """Return the inputs by `law` at one instant without corrections, (m,), or None with open-loop prediction."""
        law = self.law(x, x_ref[None], _NO_CORRECTIONS, forces, instant)
        return None if law is None else law.uncorrected[0]

    def gain(self, instant: int) -> Array:
        """Return the derivative of `inputs` at an instant by the state, (m, n), with motor lag (m, n + m).

        Raises: FeedbackError: there is no shared control law.
        """
        if self.regulator is None:
            raise FeedbackError("expected a shared control law, got open-loop prediction")
        if self._tracker is not None:
            return np.asarray(self._tracker.K[_clamped(instant, 1, len(self._tracker.K))][0])
        return self.regulator.K

    def cost_to_go(self, x0: Array, x_ref: Array, forces: Array | None = None, instant: int = 0) -> CostToGo | None:
        """Return the cost after the horizon; None if it is a multiple of the stage cost, or part of the law's weights.

        Reference state, (n,), and instant are those of step N_p; the rest as in `law`. Source: docs/equations.md (36d).
        """
        if self.regulator is None or self._settings.terminal != "riccati" or self._track is not None:
            return None
        error = self._error(x0, x_ref)
        slope = np.zeros_like(x0) if self._preview is None else self._preview.slope[self._within(instant, 1)][0]
        if forces is not None:
            forces = self._model.at_rest(forces)
            error = error - self._shift(forces)
            slope = slope + self._forced(self.regulator)[1] @ forces
        return CostToGo(root=self.regulator.root, error=error, slope=slope)

    def feedforward(self, start: int, steps: int) -> Array:
        """Return the response to the reference ahead from instant `start` on, (steps, m); zero without preview."""
        if self._preview is None:
            return np.zeros((steps, self._model.system.m))
        return self._preview.feedforward[self._within(start, steps)]

    def _error(self, x0: Array, x_ref: Array) -> Array:
        """Return the deviation of a state from reference states, (..., n); actual inputs deviate from hover."""
        n = x_ref.shape[-1]
        if len(x0) == n:
            return x0 - x_ref
        actual = np.broadcast_to(x0[n:] - self.hover.u, (*x_ref.shape[:-1], len(x0) - n))
        return np.concatenate([x0[:n] - x_ref, actual], axis=-1)

    def _shift(self, forces: Array) -> Array:
        """Return the deviation of the target from hover under forces, (n,); in it the actual inputs are the command."""
        shift: Array = self.target.M_x @ forces
        return shift if self._lag_s == 0.0 else np.concatenate([shift, self.target.M_u @ forces])

    def _regulate(self, since: int | None) -> None:
        further = self.user_costs.about(self.hover.x)
        period_s = self._settings.sampling_period_s
        self.regulator = found = self._shared(
            "regulator",
            lambda: regulator(
                self._model, self.hover, self.cost, period_s, self._uncontrolled, further, self._off, self._released,
                self._lag_s,
            ),
        )  # fmt: skip
        if self._track is not None:
            track, own = self._track, self._uncontrolled
            fail_safe = self._fail_safe
            fixed = {
                uav: (np.array([fail_safe.inputs(uav, x, k) for k, x in enumerate(track.X)]), own[uav]) for uav in own
            }
            before, self._recursion = self._tracker, None
            making = self._shared(
                "tracker",
                lambda: Recursion(
                    self._model, track, found, self.cost, self.user_costs, period_s, fixed,
                    None if since is None else before, since or 0,
                ),
            )  # fmt: skip
            if since is None or since >= making.ready:
                self._tracker = making.result()
            else:
                self._tracker, self._recursion = making.meanwhile(off=self._off), making
        if self._X_ref is not None:
            # On the reference, the output error is zero; the user's terms are not.
            states = len(found.T)
            pull = (np.sqrt(self.user_costs.weights) * self._on_reference) @ padded(further, states)
            # The actual inputs of the reference are those of hover: their deviation from the last ones is zero.
            X_ref = padded(self._X_ref, states)
            self._preview = self._shared("preview", lambda: preview(found, X_ref, pull))

    def _shared(self, what: str, compute: Callable[[], T]) -> T:
        """Return a result for this team, computed by the first controller of the reference that needs it.

        Not for others, such as a check of the scenario: the number of BLAS threads, which decides the order of sums,
        may differ.
        """
        found, key = _FOUND.setdefault(self._whole, {}), (what, *map(id, self._follows_from), *self._team)
        if key not in found:
            found[key] = compute(), self._follows_from
        result: T = found[key][0]
        return result

    def _within(self, start: int, steps: int) -> slice | npt.NDArray[np.intp]:
        """Return instants of the maneuver; later ones are replaced by its last."""
        return _clamped(start, steps, 0 if self._preview is None else len(self._preview.slope))

    def _forced(self, regulator: Regulator) -> tuple[Array, Array]:
        """Return feedforward (m, 3 + 3 N) and slope of the cost-to-go (n, 3 + 3 N) per newton.

        They are nonzero where the target misses outputs. Source: docs/equations.md (40a).
        """
        if self._by_forces is None:
            C = self._model.linearise(self.hover.x, self.hover.u).C
            missed = C.T @ (self.cost.Q[:, None] * (C @ self.target.M_x))
            further = self.user_costs.about(self.hover.x)
            missed = missed + further.T @ (further @ self.target.M_x)
            p = at_rest(regulator, regulator.T.T @ padded(missed.T, len(regulator.T)).T)
            feedforward = np.zeros_like(self.target.M_u)
            feedforward[regulator.controlled] = regulator.preview_gain @ p
            self._by_forces = feedforward, regulator.T @ p
        return self._by_forces


def _clamped(start: int, steps: int, known: int) -> slice | npt.NDArray[np.intp]:
    """Return instants from `start` on; those that are not known are replaced by the last."""
    if start + steps <= known:
        return slice(start, start + steps)
    return np.minimum(np.arange(start, start + steps), known - 1)
