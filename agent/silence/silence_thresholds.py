"""Ages of information from which on an agent is in silence, and how much it then acts alone.

As its information about the others gets old, the team's law loses its reason.
Each agent decides by the age of its own information, so that agents without any network decide alike, and
no agent waits for another. Its plan says how much, so that those who hear it predict it.
Source: docs/equations.md (32c), (63c).
"""

from dataclasses import dataclass, replace

import numpy as np

from transport.agent.silence.age_of_information import InformationAge

# Ages of information beyond the usual one at which an agent begins to act alone, and does so wholly, s. The
# reasons: a filter without information errs by centimetres within a second, and with a measured payload the
# others answer to gusts that the agent has not heard of.
OVERDUE_S = (0.5, 1.0)
# The same for the mean age of information, with a filter, s. The reason: the others answer to the errors of
# their own estimates, and an agent learns of these answers late. A measured payload has no such errors.
LATE_S = (0.15, 1.0)
# Age of information beyond the usual one from which on an estimate of forces from measured states does not
# learn, s: what the others do differently would count as a force.
_UNINFORMED_S = 0.5
# Where plans are sent on change, information is that many heartbeats later: one of them may be lost.
_HEARTBEATS = 2.0
# The usual age of information is the smallest in a window, a multiple of the age at which an agent acts wholly
# alone.
_USUAL_WINDOW = 3.0
_MEAN_WINDOW_S = 1.0  # window of the mean age of information
# Time back to the team's law, s: the estimate takes in the information meanwhile.
TO_TEAM_S = 2.0
# An agent acts alone at least as much as the largest share that it hears, minus this. Without the
# difference all would wait for each other to return.
LESS_THAN_OTHERS = 0.2
# Correlation of the errors of two agents' estimates, until information is older than usual: they share all
# measurements but the newest.
SHARED = 0.6
_FORGETS_S = 0.3  # time constant in which own measurements replace what both know


@dataclass(frozen=True, slots=True, kw_only=True)
class Ramp:
    """A share that grows from 0 to 1 between two ages, ticks."""

    begins: float
    complete: float

    @staticmethod
    def of(ages_s: tuple[float, float], later_s: float, period_s: float) -> "Ramp":
        """Return the ramp between two ages, s, both later by a time, s."""
        begins_s, complete_s = ages_s
        return Ramp(
            begins=(begins_s + later_s) / period_s, complete=(complete_s + later_s) / period_s
        )

    def not_before(self, age: float) -> "Ramp":
        """Return a ramp as long that begins at least at an age."""
        later = max(0.0, age - self.begins)
        return Ramp(begins=self.begins + later, complete=self.complete + later)

    def share(self, age: float) -> float:
        """Return the share at an age, 0 to 1."""
        return min(max((age - self.begins) / (self.complete - self.begins), 0.0), 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Silence:
    """The rule by which an agent acts alone, by the age of its information."""

    overdue: Ramp  # by the age beyond the usual one
    uninformed: float  # that age from which on what the others do is not known, ticks
    late: Ramp | None  # by the mean age; None where late information is as good as new
    # Time constant, ticks, with which errors lose their correlation once overdue information begins to count.
    forgets: float
    window: int  # ticks over which the usual age is the smallest: longer than any ramp
    recent: int  # ticks over which ages are averaged
    to_team: int  # ticks from the law alone to the team's law

    @staticmethod
    def of(period_s: float, *, is_filtered: bool, heartbeat_s: float = 0.0) -> "Silence":
        """Return the rule for a sampling period; plans come at the latest after a heartbeat, s."""
        later_s = _HEARTBEATS * heartbeat_s
        overdue = Ramp.of(OVERDUE_S, later_s, period_s)
        # Information of the tick before is on time, however long a period is.
        late = Ramp.of(LATE_S, later_s, period_s).not_before(1.0)
        return Silence(
            overdue=overdue,
            uninformed=(_UNINFORMED_S + later_s) / period_s,
            late=late if is_filtered else None,
            forgets=_FORGETS_S / period_s,
            window=round(_USUAL_WINDOW * overdue.complete),
            recent=max(1, round(_MEAN_WINDOW_S / period_s)),
            to_team=round(TO_TEAM_S / period_s),
        )

    @property
    def after_failures(self) -> "Silence":
        """The rule of a team of which UAVs have failed.

        No information is late: three UAVs that each follow a reference do not balance a load of four.
        """
        return replace(self, late=None)

    def alone(self, age: InformationAge) -> float:
        """Return the share of the law alone, 0 to 1, by the age of information. Source: (32c)."""
        late = 0.0 if self.late is None else self.late.share(age.mean)
        return max(late, self.overdue.share(age.overdue))

    def correlation(self, age: InformationAge) -> float:
        """Return the correlation of two agents' errors by the age of information. Source: (63c)."""
        since_begin = age.overdue - self.overdue.begins
        if since_begin <= 0.0:
            return SHARED
        return float(SHARED * np.exp(-since_begin / self.forgets))
