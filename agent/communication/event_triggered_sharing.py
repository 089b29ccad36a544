"""Event-triggered sharing of plans: only those that the others could not have predicted."""

import math

import msgspec
import numpy as np

from transport.agent.silence.silence_thresholds import LESS_THAN_OTHERS
from transport.model.arrays import Array
from transport.protocol.scenario.sections.schema import ControllerSection

# At most this much below a whole number of periods, by rounding, a heartbeat counts as that number.
_ROUNDING = 1e-9
# Change of the share of the law alone beyond which a plan is shared: an agent that hears it acts alone
# by as much less (32c), so that a share heard too late holds it back no more than the present one.
_ALONE_CHANGE = LESS_THAN_OTHERS


class Corrections(msgspec.Struct, frozen=True, kw_only=True):
    """Corrections of a plan to the shared control law."""

    tick: int  # of the plan
    start: int  # tick of the first step
    c: Array  # (N_p, 4 owned)
    roster: int  # version of the roster in force
    alone: float = 0.0  # share of the law alone in the plan's inputs, 0 to 1

    def from_tick(self, start: int, steps: int) -> Array:
        """Return the corrections over some steps from a tick on, zero after their end, (32)."""
        remaining = self.c[start - self.start :][:steps]
        c = np.zeros((steps, self.c.shape[1]))
        c[: len(remaining)] = remaining
        return c


class Sharing:
    """Rule by which an agent shares its plans.

    With closed-loop prediction the others know the shared control law, but not the agent's
    corrections to it nor how much it acts alone. They assume the last shared corrections, shifted to
    the present tick and zero after their end, and the last shared share of the law alone.

    Args:
        section: Settings of the controller.
        lower: Smallest inputs of the agent's UAVs, (4 owned,); their range is the scale of changes.
        upper: Largest ones.
    """

    def __init__(self, section: ControllerSection, lower: Array, upper: Array) -> None:
        self._is_always = section.share == "always"
        self._threshold = section.share_threshold
        periods = section.share_heartbeat_s / section.sampling_period_s
        self._heartbeat = max(1, math.floor(periods + _ROUNDING))  # ticks
        self._range = upper - lower
        self._shared: Corrections | None = None  # of the last plan that was shared

    def renew(self) -> None:
        """Share the next plan, whatever it is."""
        self._shared = None

    def decide(self, plan: Corrections) -> bool:
        """Decide whether to share a plan; the others assume a shared plan from then on.

        Shared are the first plan, the first one under each roster (control law or receivers may be
        new), one that is a heartbeat newer than the last shared one, one whose corrections have
        changed by more than the threshold of the inputs' range, and one whose share of the law alone
        has changed.
        Source: docs/equations.md (49).
        """
        is_shared = self._is_always or self._differs(plan)
        if is_shared:
            self._shared = plan
        return is_shared

    def _differs(self, plan: Corrections) -> bool:
        last = self._shared
        if last is None or plan.roster != last.roster:
            return True
        if plan.tick - last.tick >= self._heartbeat:
            return True
        if abs(plan.alone - last.alone) > _ALONE_CHANGE:
            return True

        #   sigma_k = max |c - c_assumed| / (u_max - u_min)
        assumed = last.from_tick(plan.start, len(plan.c))
        sigma = np.max(np.abs(plan.c - assumed) / self._range, initial=0.0)
        return bool(sigma > self._threshold)
