"""Margins of the law of UAVs alone of drawn teams (`python -m benchmarks.teams --margins`): decay, delay and lag."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import threadpoolctl

from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.design_of_gains_alone import DECAY_PER_S, FAMILY
from transport.mpc.margins.sampled_loop import margins
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.drawn_team import drawn

TEAMS = 60
DELAY_MS, LAG_MS = 20.0, 25.0  # wanted margins
HEADINGS = (
    f"law alone of {TEAMS} drawn teams",
    f"decays by {DECAY_PER_S:g}/s",
    f"delay margin {DELAY_MS:g} ms",
    f"lag margin {LAG_MS:g} ms",
    "all",
    "refused",
)


@dataclass(frozen=True, slots=True)
class MarginsAlone:
    """Growth of deviations of the hover of a team of UAVs alone, 1/s, and its margins of delay and lag, ms."""

    growth: float
    delay_ms: float
    lag_ms: float

    @property
    def met(self) -> tuple[bool, bool, bool]:
        """Which of the criteria hold: decay, delay, lag."""
        return self.growth < -DECAY_PER_S, self.delay_ms >= DELAY_MS, self.lag_ms >= LAG_MS

    def text(self) -> str:
        """Return the numbers in words."""
        return f"growth {self.growth:.3f}/s, delay {self.delay_ms:.0f} ms, lag {self.lag_ms:.0f} ms"


def margins_alone(setup: Setup, *, designed: bool) -> MarginsAlone:
    """Compute the margins with the gains designed for a team, or with those of rings."""
    team = setup.team_alone(next_tick=setup.scenario.clock.next_tick)
    gains = team.design().gains if designed else FAMILY[0]
    with threadpoolctl.threadpool_limits(1):
        loop = team.loop(gains)
        growth = loop.growth(Mismatch())
        ranges = margins(loop, ("delay_s", "lag_s"))
    if not ranges:  # of an unstable loop
        return MarginsAlone(growth, 0.0, 0.0)
    uppers_s = [math.inf if one.upper is None else one.upper for one in ranges.values()]
    return MarginsAlone(growth, *(1e3 * upper_s for upper_s in uppers_s))


def count(template: tuple[Scenario, str], *, first: int, each: bool) -> list[list[str]]:
    """Compute decay and margins of UAVs alone, with the designed gains and with those of rings.

    Args:
        template: The scenario from which teams are drawn, and its file.
        first: Seed of the first team.
        each: Whether a line is printed for each team, also for those that meet all criteria.
    """
    setups = {}
    for seed in range(first, first + TEAMS):
        try:
            setups[seed] = Setup.of(drawn(seed, *template), f"team {seed}")
        except ScenarioError as error:
            sys.stdout.write(f"team {seed}: {error}\n")

    rows = []
    for name, designed in (("designed for the team", True), ("gains of rings", False)):
        found = {seed: margins_alone(setup, designed=designed) for seed, setup in setups.items()}
        for seed, one in found.items():
            if each or (designed and not all(one.met)):
                sys.stdout.write(f"team {seed}: {one.text()}\n")
        refused = TEAMS - len(setups) if designed else 0
        rows.append(cells(name, list(found.values()), refused))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
    return rows


def cells(name: str, teams: Sequence[MarginsAlone], refused: int) -> list[str]:
    """Return a row: how many teams meet each criterion, and all of them, and how many are refused."""
    met = [one.met for one in teams]
    counts = [*np.sum(met, axis=0), sum(map(all, met))]
    return [name, *(f"{number} of {len(teams)}" for number in counts), f"{refused}"]
