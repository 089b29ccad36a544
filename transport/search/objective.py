"""Robustness of a run: how far it is from failing, below zero once it has failed."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from transport.analysis.events import TIME_DIGITS
from transport.analysis.series import Series
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario

Measure = Literal["attitude", "separation", "payload", "constraint", "cost"]
MEASURES = get_args(Measure)

# Default limits: attitude and payload error as in docs/record/guarantees.md; violation of the user's own
# constraints, in their units, and of limits, as a share of their range; mean cost.
_LIMITS: Mapping[str, float] = {"attitude": 10.0, "payload": 1.0, "constraint": 0.1, "cost": 10.0}
# Units of numbers and limits, where they have the same for every scenario.
_UNITS: Mapping[str, str] = {"attitude": "deg", "separation": "m", "payload": "m"}
_SEPARATION_SHARE = 0.9  # of the minimum of the constraint, which is soft
_SEPARATION_M = 0.4  # this minimum, where a scenario has no constraint


def _largest_violation(summary: Mapping[str, Any]) -> float | None:
    """Return the largest violation of a limit or of an own constraint; None if one is not finite."""
    own = [constraint["violation_max"] for constraint in summary["own_constraints"]]
    violations = [summary["constraint_violation_max"], *own]
    return None if None in violations else max(violations)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchObjective:
    """A number of a run and its limit."""

    measure: Measure
    limit: float  # deg, m, m, the constraint's unit, cost

    @staticmethod
    def of(measure: str, limit: float | None, scenario: Scenario) -> "SearchObjective":
        """Return an objective with its default limit. Raises: ScenarioError: there is no such one."""
        if measure not in MEASURES:
            expected = f"expected one of {', '.join(MEASURES)}"
            raise ScenarioError("--objective", "", f"{expected}, got {measure!r}")

        if limit is not None and not (math.isfinite(limit) and limit > 0.0):
            raise ScenarioError("--limit", "", f"expected a number above 0, got {limit:g}")
        if limit is None and measure == "separation":
            separation = scenario.controller.separation
            limit = _SEPARATION_SHARE * (separation.minimum_m if separation else _SEPARATION_M)

        return SearchObjective(
            measure=measure,  # type: ignore[arg-type]  # checked above
            limit=_LIMITS[measure] if limit is None else limit,
        )

    def value(self, summary: Mapping[str, Any]) -> float:
        """Return the number of a run; infinite (zero for a distance) where the run has none."""
        value = {
            "attitude": summary["attitude_max_deg"],
            "separation": summary["separation_min_m"],
            "payload": summary["payload_tracking"]["max_m"],
            "constraint": _largest_violation(summary),
            "cost": summary["cost"]["mean"],
        }[self.measure]
        if value is None:
            return 0.0 if self.measure == "separation" else math.inf
        return float(value)

    def passed_s(self, series: Series) -> float | None:
        """Return when a run first passes the limit, s.

        None where it does not, and for a violation or the cost, which are of the whole run.
        """
        values = {
            "attitude": series.attitude_max_deg,
            "separation": series.separation_m,
            "payload": series.payload_error_norm_m,
        }.get(self.measure)
        if values is None:
            return None

        is_beyond = values < self.limit if self.measure == "separation" else values > self.limit
        if not is_beyond.any():
            return None
        first = int(is_beyond.argmax())
        return round(float(series.times_s[first]), TIME_DIGITS)

    def robustness(self, value: float, survived: float) -> float:
        """Return the distance from failing: 1 far away, 0 at the limit, -1 to 0 after a failure.

        Args:
            value: Number of the run.
            survived: Share of the run until it diverged or passed the limit for certain; 1
                otherwise. An earlier failure is a worse one.
        """
        if survived < 1.0:
            return survived - 1.0
        margin = value / self.limit - 1.0
        if self.measure != "separation":
            margin = -margin
        return max(-1.0, min(1.0, margin))

    def in_words(self, value: float) -> str:
        """Return the number of a run with its unit."""
        names = {
            "attitude": f"attitude {value:.2f}",
            "separation": f"smallest distance {value:.3f}",
            "payload": f"payload error {value:.3f}",
            "constraint": f"violation {value:.3g}",
            "cost": f"cost {value:.3g}",
        }
        return self._with_unit(names[self.measure])

    def limit_in_words(self) -> str:
        """Return the limit with its unit."""
        return self._with_unit(f"{self.limit:g}")

    def _with_unit(self, number: str) -> str:
        """Return a number with the unit of the measure, if it has one."""
        unit = _UNITS.get(self.measure)
        return f"{number} {unit}" if unit else number
