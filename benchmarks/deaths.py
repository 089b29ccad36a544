"""Random deaths: `python -m benchmarks.deaths` kills two agents for good and tells how teams of 4 and 6 go on.

Two different agents; the first dies at any time from 1 s to 20 s, the second some seconds later (exponential,
mean 3 s). Each on a perfect network and with 200 ms delay and 30 % packet loss.
"""

from typing import Any

import numpy as np

import transport
from benchmarks.campaign import changes, options, runs, say

NETWORKS: dict[str, dict[str, Any]] = {"perfect": {}, "200 ms, 30 %": {"links.delay_s": 0.2, "links.loss": 0.3}}
# Sampling period of the times, s.
PERIOD_S = 0.05


def drawn(uavs: int, number: int, seed: int) -> list[tuple[int, float]]:
    """Return agents, 1-based, and times of their deaths, s."""
    draw = np.random.default_rng([seed, uavs, number])
    agents = draw.choice(uavs, 2, replace=False) + 1
    first = draw.uniform(1.0, 20.0)
    times = np.minimum((first, first + draw.exponential(3.0)), 23.0)
    return [(int(a), round(round(t / PERIOD_S) * PERIOD_S, 3)) for a, t in zip(agents, times, strict=True)]


def main() -> None:
    """Simulate the deaths and print a row for each, then a summary for each team and network."""
    parser = options("deaths", __doc__, changes=True)
    parser.add_argument("--scenario", default="resilient")
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--uavs", type=int, action="append", help="size of the team; may be repeated (4, 6)")
    given = parser.parse_args()
    for uavs in given.uavs or (4, 6):
        team = transport.Scenario(given.scenario).resized(uavs)
        deaths = [drawn(uavs, number, given.seed) for number in range(given.count)]
        for network, links in NETWORKS.items():
            scenarios = []
            for own in deaths:
                events = [{"at_s": at_s, "do": "kill", "target": f"agent{agent}"} for agent, at_s in own]
                lost = {"faults.event": events, "clock.on_agent_loss": "continue"}
                scenarios.append(team.copy({**lost, **links, **changes(given.changes)}))
            found = [results[0] for results in runs(scenarios)]
            for number, (own, result) in enumerate(zip(deaths, found, strict=True)):
                run, text = result.numbers, ", ".join(f"{agent} at {at_s:5.2f} s" for agent, at_s in own)
                say(
                    f"{uavs} UAVs, {number:2d}, agents {text}, {network:12s} {result.outcome:9s} cost "
                    f"{run['cost_mean']:.3g}, {run['attitude_max_deg']:5.2f} deg, {run['separation_min_m']:.3f} m"
                )
            names = ("attitude_max_deg", "separation_min_m")
            attitude_deg, separation_m = (np.array([result.numbers[name] for result in found]) for name in names)
            say(
                f"{uavs} UAVs, {network}: {sum(result.outcome == 'completed' for result in found)} of {len(found)} "
                f"complete; largest attitude median {np.median(attitude_deg):.1f}, at most {attitude_deg.max():.1f} "
                f"deg; least separation median {np.median(separation_m):.2f}, at least {separation_m.min():.2f} m"
            )


if __name__ == "__main__":
    main()
