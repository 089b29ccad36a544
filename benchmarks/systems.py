"""Random systems: `python -m benchmarks.systems` simulates teams drawn from a seed and tells how many complete.

Teams of 2 to 8 unequal UAVs, masses over a decade, sampling periods of 0.02 to 0.1 s, horizons of 8 to 40 steps; each
on a perfect network and with a delay up to 0.4 s and packet loss up to 60 %. Only the system, the limits of its
actuators, sampling period, horizon and links differ from the scenario that is given.
"""

import math
from typing import Any

import numpy as np

import transport
from benchmarks.campaign import changes, completed, options, runs, say

# A diagonal leg excites the modes that the paper's maneuver leaves at rest by symmetry.
PHASES = [
    {"name": "hover", "duration_s": 1.0, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 3.0, "displacement_m": [0.0, 0.0, -1.5]},
    {"name": "diagonal", "duration_s": 4.0, "displacement_m": [1.6, 1.2, 0.0]},
    {"name": "hover", "duration_s": 4.0, "displacement_m": [0.0, 0.0, 0.0]},
]
PERIODS_S = (0.02, 0.025, 0.04, 0.05, 0.08, 0.1)


def drawn(base: str, number: int, seed: int) -> tuple[transport.Scenario, dict[str, Any]]:
    """Return a random system on a perfect network, and the settings that impair it."""
    draw = np.random.default_rng([seed, number])
    N, period_s, horizon = int(draw.integers(2, 9)), float(draw.choice(PERIODS_S)), int(draw.integers(8, 41))
    mass_kg = 0.5 * 10.0 ** draw.uniform()  # of a typical UAV
    masses = mass_kg * draw.uniform(0.75, 1.25, N)
    load_kg = N * mass_kg * draw.uniform(0.3, 0.7)
    arm_m = 0.25 * (mass_kg / 1.5) ** (1.0 / 3.0)
    apart_m = 2.0 * arm_m * draw.uniform(1.0, 1.4)  # of neighbours
    radius_m = apart_m / (2.0 * math.sin(math.pi / N))
    unit = mass_kg * arm_m**2
    settings: dict[str, Any] = {
        "system.payload.mass_kg": float(load_kg),
        "system.payload.inertia_kgm2": [float(load_kg / 3.0 * radius_m**2 * f) for f in draw.uniform(1.2, 1.6, 3)],
        "controller.sampling_period_s": period_s,
        "controller.horizon": horizon,
        "controller.separation.minimum_m": 0.75 * apart_m,
        "controller.limits.moments_Nm": [float(f * unit) for f in (11.0, 11.0, 5.5)],
        "controller.limits.moment_rates_Nm_s": [float(f * unit) for f in (110.0, 110.0, 55.0)],
        "maneuver.phase": PHASES,
    }
    for i in range(N):
        angle = math.pi / N * (1 - 2 * i)
        uav = f"system.uav.{i + 1}."
        settings[uav + "mass_kg"] = float(masses[i])
        settings[uav + "inertia_kgm2"] = [float(f * masses[i] * arm_m**2) for f in (0.31, 0.31, 0.55)]
        settings[uav + "rho_m"] = [round(radius_m * f, 6) + 0.0 for f in (math.cos(angle), math.sin(angle), -0.3)]
        settings[uav + "rod_length_m"] = float(draw.uniform(1.5, 4.0))
    hover_N = (float(masses.max()) + load_kg / N) * 9.81
    settings["controller.limits.thrust_N"] = [0.0, 2.5 * hover_N]
    settings["controller.limits.thrust_rate_N_s"] = 6.0 * hover_N
    links = {"links.delay_s": float(draw.uniform(0.0, 0.4)), "links.loss": float(draw.uniform(0.0, 0.6))}
    return transport.Scenario(base, allow_large=True).resized(N).copy(settings), links


def main() -> None:
    """Simulate the systems and print a row for each."""
    parser = options("systems", __doc__, changes=True)
    parser.add_argument("--scenario", default="resilient", help="scenario that the systems are put into")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, action="append", help="the system of this number; may be repeated")
    parser.add_argument("--perfect", action="store_true", help="on a perfect network only")
    given = parser.parse_args()
    numbers = given.only or range(given.count)
    systems = [drawn(given.scenario, number, given.seed) for number in numbers]
    perfect = [scenario.copy(changes(given.changes)) for scenario, _ in systems]
    impaired = [] if given.perfect else [one.copy(links) for one, (_, links) in zip(perfect, systems, strict=True)]
    found = [result for (result,) in runs([*perfect, *impaired])]
    say("number  N  T_s, ms  N_p  mass, kg  delay, ms  loss  perfect  impaired  cost ratio")
    ratios = []
    for i, number in enumerate(numbers):
        own = found[i :: len(numbers)]
        if len(there := completed(own)) == 2:
            ratios.append(there[1]["cost_mean"] / there[0]["cost_mean"])
        tree, links = perfect[i].tree(), systems[i][1]
        uavs, controller = tree["system"]["uav"], tree["controller"]
        ends = (f"{run.numbers['lost_s']:.1f} s" if run.numbers["lost_s"] else run.outcome for run in own)
        costs = (f"{end:>9s} {run.numbers['cost_mean']:9.3g}" for end, run in zip(ends, own, strict=True))
        say(
            f"{number:6d} {len(uavs):2d} {1e3 * controller['sampling_period_s']:8.0f} {controller['horizon']:4d} "
            f"{uavs[0]['mass_kg']:9.2f} {1e3 * links['links.delay_s']:10.0f} {links['links.loss']:5.2f} "
            + " ".join(costs)
        )
    for name, own in (("perfect", found[: len(numbers)]), ("impaired", found[len(numbers) :])):
        if own:
            say(f"{name}: {len(completed(own))} of {len(own)} complete")
    if ratios:
        say(f"cost ratio: median {np.median(ratios):.3f}, nine in ten at most {np.quantile(ratios, 0.9):.3f}")


if __name__ == "__main__":
    main()
