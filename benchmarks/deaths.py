"""Random deaths: `python -m benchmarks.deaths` kills two agents for good and tells how teams of 4 and 6 go on.

Two different agents; the first dies at any time from 1 s to 20 s, the second some seconds later (exponential,
mean 3 s). Each on a perfect network and with 200 ms delay and 30 % packet loss.
"""

import argparse
import sys
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

import transport

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


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate the deaths and print a row for each, then a summary for each team and network; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.deaths", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenario", default="resilient")
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--uavs", type=int, action="append", help="size of the team; may be repeated (4, 6)")
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    changes = {key: tomllib.loads(f"v={value}")["v"] for key, value in (c.split("=", 1) for c in options.changes)}
    summaries = []
    for uavs in options.uavs or (4, 6):
        team = transport.Scenario(options.scenario).resized(uavs)
        found: dict[str, list[tuple[float, ...]]] = {network: [] for network in NETWORKS}
        for number in range(options.count):
            deaths = drawn(uavs, number, options.seed)
            events = [{"at_s": at_s, "do": "kill", "target": f"agent{agent}"} for agent, at_s in deaths]
            text = ", ".join(f"{agent} at {at_s:5.2f} s" for agent, at_s in deaths)
            for network, links in NETWORKS.items():
                scenario = team.copy({"faults.event": events, "clock.on_agent_loss": "continue", **links, **changes})
                run = transport.fly(scenario, progress=False)
                result = run.summary
                row = (float(run.completed), result["attitude_max_deg"], result["separation_min_m"])
                found[network].append(row)
                sys.stdout.write(
                    f"{uavs} UAVs, {number:2d}, agents {text}, {network:12s} {run.outcome:9s} "
                    f"cost {result['cost']['mean']:.3g}, {row[1]:5.2f} deg, {row[2]:.3f} m\n"
                )
                sys.stdout.flush()
        for network, rows in found.items():
            completed, attitude_deg, separation_m = np.array(rows).T
            summaries.append(
                f"{uavs} UAVs, {network}: {completed.sum():.0f} of {len(rows)} complete; largest attitude median "
                f"{np.median(attitude_deg):.1f}, at most {attitude_deg.max():.1f} deg; least separation median "
                f"{np.median(separation_m):.2f}, at least {separation_m.min():.2f} m\n"
            )
    sys.stdout.writelines(summaries)
    return 0


if __name__ == "__main__":
    sys.exit(main())
