"""Measured tables of controllers: other engines, their values and weights (docs/record: engines, values, measured)."""

from collections.abc import Mapping
from functools import partial

import numpy as np
from table_rows_and_cells import (
    CABLES,
    COST,
    ESTIMATE,
    HEAVIER,
    IMPAIRED,
    LATE,
    MUJOCO,
    Run,
    cell,
    completed,
    grid,
    listed,
    unless_diverged,
)

from transport.experiments.weather_experiment import SENSORS

# docs/record/engines.md

# A maneuver that descends almost as fast as bodies fall.
FALL = (
    'maneuver.phase=[{name="hover",duration_s=1.0,displacement_m=[0.0,0.0,0.0]},'
    '{name="descend",duration_s=1.0,displacement_m=[0.0,0.0,6.0]},'
    '{name="hover",duration_s=3.0,displacement_m=[0.0,0.0,0.0]}]'
)
ON_CABLES = {
    "`resilient`": Run("resilient", (MUJOCO, CABLES)),
    "`eight` at 5 m/s, 200 ms delay, 30 % packet loss": Run("eight", (MUJOCO, CABLES, *LATE)),
    "`resilient`, 6 m down in 1 s": Run("resilient", (MUJOCO, CABLES, FALL)),
    "`resilient`, the same, with `controller.tension.minimum_N=2`": Run(
        "resilient", (MUJOCO, CABLES, FALL, "controller.tension.minimum_N=2.0")
    ),
}
# Scenarios with body rates, in which the modelled inner loop and the firmware are compared.
FIRMWARE: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("`resilient`", "perfect network"): (),
    ("`resilient`", "in MuJoCo"): (MUJOCO,),
    ("`resilient`", "200 ms delay, 30 % packet loss"): LATE,
    ("`precise`", "200 ms delay, 30 % packet loss"): LATE,
    ("`precise`", "200 ms delay, 30 % packet loss, no sensor at the payload, noise"): (
        *LATE,
        *SENSORS,
    ),
    ("`eight`", "as it is"): (),
}


def inner(loop: str, scenario: str, settings: tuple[str, ...]) -> Run:
    """Return the run with an inner loop."""
    return Run(
        scenario.strip("`"), ("controller.inputs=rates", f"plant.inner_loop={loop}", *settings)
    )


ENGINES = (
    grid(
        "controllers",
        ["scenario", "network"],
        ["`rods`: payload error", "`mujoco`: payload error"],
        {
            (f"`{name}`", network): [Run(name, settings), Run(name, (MUJOCO, *settings))]
            for name in ("resilient", "precise")
            for network, settings in {"perfect": (), "200 ms delay, 30 % packet loss": LATE}.items()
        },
        unless_diverged(
            cell("payload_rms_m", "{:.2f} cm rms", 100.0), cell("payload_max_m", "{:.2f} cm", 100.0)
        ),
    ),
    listed(
        "cables",
        "on cables",
        ON_CABLES,
        {
            "payload error, largest": cell("payload_max_m", "{:.1f} cm", 100.0),
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
            key: [inner(loop, key[0], settings) for loop in ("model", "betaflight")]
            for key, settings in FIRMWARE.items()
        },
        unless_diverged(COST),
    ),
)


# docs/record/values.md and docs/record/measured.md

COMPARED = ("paper", "centralized", "resilient", "centralized_lq", "precise")
WEIGHTS = (
    "controller.weights.attitude=0.5",
    "controller.weights.attitude=50",
    "controller.weights.acceleration=5e-4",
    "controller.weights.acceleration=5e-2",
    "controller.weights.angular_acceleration=1.7e-4",
    "controller.weights.angular_acceleration=1.7e-2",
    "controller.horizon=5",
    "controller.horizon=10",
    "controller.horizon=30",
    "maneuver.profile=min_jerk",
    "maneuver.profile=step",
)
STILL = "maneuver.phase=[{name='hover',duration_s=20,displacement_m=[0,0,0]}]"
PLANTS = {"15 % more payload": f"{HEAVIER}=1.15", "wind of 5 m/s": "plant.wind.speed_mps=[5,0,0]"}
WITH_ESTIMATE = {
    "without estimate": (),
    "with estimate": (ESTIMATE,),
    "with estimate, 100 ms delay, 30 % loss": (ESTIMATE, *IMPAIRED),
}
OPEN_LOOP = (
    "controller.prediction=open_loop",
    "controller.terminal=multiple",
    "controller.preview=false",
)
WINDY = {
    "as it is": (),
    "without the estimate": ("controller.disturbance.estimate=false",),
    "100 ms delay, 30 % loss": IMPAIRED,
    "open-loop prediction": OPEN_LOOP,
}
VALUES = (
    listed(
        "follows",
        "",
        {f"`{name}`": Run(name) for name in COMPARED},
        {
            "cost, mean": COST,
            "payload attitude": cell("attitude_max_deg", "{:.2f} deg"),
            "UAV error, rms": cell("uav_rms_m", "{:.1f} cm", 100.0),
            "payload error, rms": cell("payload_rms_m", "{:.1f} cm", 100.0),
            "largest payload error": cell("payload_max_m", "{:.1f} cm", 100.0),
            "the same in the last 4 s": cell("swing_m", "{:.1f} cm", 100.0),
            "smallest distance of two UAVs": cell("separation_min_m", "{:.3f} m"),
        },
    ),
    grid(
        "weights",
        ["`--set`"],
        ["`paper`", "`resilient`"],
        {
            text: [Run("paper", settings), Run("resilient", settings)]
            for text, settings in {
                "nothing": (),
                **{f"`{setting}`": (setting,) for setting in WEIGHTS},
            }.items()
        },
        unless_diverged(
            cell("attitude_max_deg", "{:.2f} deg"), cell("swing_m", "{:.0f} cm", 100.0)
        ),
    ),
    grid(
        "plant_state",
        [""],
        list(WITH_ESTIMATE),
        {
            text: [
                Run("resilient", (STILL, setting, *changes)) for changes in WITH_ESTIMATE.values()
            ]
            for text, setting in PLANTS.items()
        },
        unless_diverged(cell("uav_last_m", "{:.2f} cm", 100.0), COST),
    ),
    listed(
        "windy",
        "",
        {text: Run("windy", settings, seeds=8) for text, settings in WINDY.items()},
        {
            "completed": completed,
            "attitude, mean": cell("attitude_max_deg", "{:.2f} deg"),
            "mean cost": cell("cost_mean", "{:.2f}"),
            "smallest distance": cell("separation_min_m", "{:.2f} m", of=np.min),
            "largest swing": cell("swing_m", "{:.2f} m", of=np.max),
        },
    ),
)


def team(uavs: int) -> list[Run]:
    """Return the runs of a team size: without delay, with it, and that of the paper's algorithm."""
    resilient = partial(Run, "resilient", uavs=uavs)
    return [resilient(), resilient(("links.delay_s=0.1",)), Run("paper", uavs=uavs)]


COST_AND_ATTITUDE = unless_diverged(COST, cell("attitude_max_deg", "{:.2f} deg"))
SCENARIO = (
    grid(
        "teams",
        ["UAVs"],
        ["without delay", "0.1 s", "`--from paper`"],
        {str(uavs): team(uavs) for uavs in (2, 3, 4, 6, 8)},
        COST_AND_ATTITUDE,
    ),
)
TIME = (
    grid(
        "negotiation_iterations",
        ["iterations"],
        ["`paper`", "`resilient`"],
        {
            str(count): [
                Run(name, (f"controller.negotiation_iterations={count}",))
                for name in ("paper", "resilient")
            ]
            for count in (1, 2, 4)
        },
        COST_AND_ATTITUDE,
    ),
)
