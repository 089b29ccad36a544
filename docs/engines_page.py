"""Renew the measured tables of docs/engines.md, or those named as arguments: part of `make figures`, five minutes."""

from collections.abc import Mapping
from importlib import metadata

import numpy as np
from simulations import COST, Run, cell, completed, events, grid, listed, renew, unless_diverged

from plant.engines import engine_version

MUJOCO, CABLES = "plant.engine=mujoco", "plant.mujoco.suspension=cables"
LATE = ("links.delay_s=0.2", "links.loss=0.3")
RMS, MOST = cell("payload_rms_m", "{:.2f} cm rms", 100.0), cell("payload_max_m", "{:.2f} cm", 100.0)

# Suspensions of the load, as settings of MuJoCo.
SUSPENSIONS: Mapping[str, tuple[str, ...]] = {
    "rods of 1 g": (),
    "rods of 10 g": ("plant.mujoco.rod_mass_kg=0.01",),
    "rods of 100 g": ("plant.mujoco.rod_mass_kg=0.1",),
    "rods of 100 g, with `controller.disturbance.estimate`": (
        "plant.mujoco.rod_mass_kg=0.1",
        "controller.disturbance.estimate=true",
    ),
    "cables": (CABLES,),
}


def dip(at_s: float, duration_s: float, share: float) -> str:
    """Return the fault of a UAV that has a share of its thrust and moments for some time."""
    ends = ((at_s, share), (at_s + duration_s, 1.0))
    faults = (f'{{at_s={t},do="degrade",target="uav2",efficiency={e}}}' for t, e in ends)
    return f"faults.event=[{','.join(faults)}]"


def fall(depth_m: float) -> str:
    """Return a maneuver that descends almost as fast as bodies fall, in a second."""
    ways = (("hover", 1.0, 0.0), ("descend", 1.0, depth_m), ("hover", 3.0, 0.0))
    phases = (f'{{name="{name}",duration_s={s},displacement_m=[0.0,0.0,{down}]}}' for name, s, down in ways)
    return f"maneuver.phase=[{','.join(phases)}]"


TAUT = "controller.tension.minimum_N=2.0"
SLOWER = ("maneuver.phase.2.speed_mps=3.0", *LATE)
ON_CABLES: Mapping[str, tuple[str, ...]] = {
    "`resilient`": (),
    "`eight` at 5 m/s, 200 ms delay, 30 % packet loss": LATE,
    "`eight` at 3 m/s, the same network": SLOWER,
    "`resilient`, UAV 2 with 5 % of its thrust for 0.15 s": (dip(8.0, 0.15, 0.05),),
    "`eight` at 3 m/s, the same network, UAV 2 with 5 % of its thrust for 0.15 s": (*SLOWER, dip(10.0, 0.15, 0.05)),
    "`eight` at 3 m/s, the same network, UAV 2 with 30 % of its thrust for 0.3 s": (*SLOWER, dip(10.0, 0.3, 0.3)),
    "`resilient`, 6 m down in 1 s": (fall(6.0),),
    "`resilient`, the same, with `controller.tension.minimum_N=2`": (fall(6.0), TAUT),
    "`precise`, 7 m down in 1 s": (fall(7.0),),
    "`precise`, the same, with `controller.tension.minimum_N=2`": (fall(7.0), TAUT),
}

# Runs with body rates, and the inner loops that are compared in them.
DEATH = events((8.0, "kill", "agent3"))
SENSORS = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "plant.noise={position_m=0.01,velocity_mps=0.02,attitude_rad=0.0087,rate_rads=0.0175,specific_force_mps2=0.3}",
)
FIRMWARE: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("resilient", "perfect network"): (),
    ("resilient", "motor lag of 50 ms (`plant.motors.lag_s=0.05`)"): ("plant.motors.lag_s=0.05",),
    ("resilient", "in MuJoCo"): (MUJOCO,),
    ("resilient", "200 ms delay, 30 % packet loss"): LATE,
    ("resilient", "the same, agent 3 killed at 8 s for good"): (*LATE, *DEATH),
    ("precise", "perfect network"): (),
    ("precise", "200 ms delay, 30 % packet loss"): LATE,
    ("precise", "the same, agent 3 killed at 8 s for good"): (*LATE, *DEATH),
    ("precise", "200 ms delay, 30 % packet loss, no sensor at the payload, noise"): (*LATE, *SENSORS),
    ("eight", "as it is"): (),
}


def inner(loop: str, scenario: str, settings: tuple[str, ...]) -> Run:
    """Return the run with an inner loop."""
    return Run(scenario, ("controller.inputs=rates", f"plant.inner_loop={loop}", *settings))


PAGES = {
    "engines.md": (
        grid(
            "controllers",
            ["scenario", "network"],
            ["`rods`: payload error", "`mujoco`: payload error"],
            {
                (f"`{name}`", network): [Run(name, settings), Run(name, (MUJOCO, *settings))]
                for name in ("resilient", "precise")
                for network, settings in {"perfect": (), "200 ms delay, 30 % packet loss": LATE}.items()
            },
            unless_diverged(RMS, MOST),
        ),
        listed(
            "suspensions",
            "`resilient` in MuJoCo with",
            {text: Run("resilient", (MUJOCO, *settings)) for text, settings in SUSPENSIONS.items()},
            {"payload error": unless_diverged(RMS, MOST)},
        ),
        listed(
            "cables",
            "on cables",
            {text: Run(text.split("`")[1], (MUJOCO, CABLES, *settings)) for text, settings in ON_CABLES.items()},
            {
                "payload error, largest": unless_diverged(cell("payload_max_m", "{:.1f} cm", 100.0)),
                "at the end": cell("payload_last_m", "{:.1f} cm", 100.0),
                "smallest tension": cell("tension_min_N", "{:.2f} N"),
                "times slack": cell("slack", "{:.0f}"),
                "longest": cell("slack_longest_s", "{:.2f} s"),
            },
        ),
        grid(
            "firmware",
            ["scenario", "settings"],
            ["modelled", "Betaflight"],
            {
                (f"`{name}`", what): [inner(loop, name, settings) for loop in ("model", "betaflight")]
                for (name, what), settings in FIRMWARE.items()
            },
            unless_diverged(COST),
        ),
        listed(
            "deliveries",
            "`delivery`",
            {"noise of `windy`, seeds 0 to 9": Run("delivery", seeds=10)},
            {
                "completed": completed,
                "distance of the payload from its target, median": cell(
                    "payload_last_m", "{:.1f} cm", 100.0, np.median
                ),
                "largest": cell("payload_last_m", "{:.1f} cm", 100.0, np.max),
            },
        ),
    )
}

if __name__ == "__main__":
    renew(PAGES, f", mujoco {engine_version('mujoco')}, betaflight {metadata.version('betaflight')}")
