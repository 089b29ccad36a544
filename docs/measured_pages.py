"""Measured tables of the pages below, which `make figures` renews.

A section for each page, which a comment names: first the runs of its tables as settings of ready
scenarios, then the tables, which `PAGES` assigns to the page. A table stands in its page between the
markers of its name, and `docs/simulations.py` has its parts:

    Run       a scenario, its settings, the number of UAVs and of seeds
    cell      a number of the summary, its format, and a factor to the unit shown (m to cm: 100)
    listed    a table with a run in each row, and a number in each column
    grid      a table with a run in each cell

To add a row, add a run; `make figures TABLES=name` simulates what has no kept result.
"""

import math
from collections.abc import Mapping
from functools import partial
from itertools import product

import numpy as np
from simulations import (
    ATTITUDE,
    COST,
    Cell,
    Flown,
    Run,
    Table,
    cell,
    completed,
    events,
    grid,
    interval,
    listed,
    outcome,
    unless_diverged,
    values,
)

from transport.experiments.weather_experiment import SENSORS

# Settings of several tables: impaired networks, errors of the model, the other engine.
LATE = ("links.delay_s=0.2", "links.loss=0.3")
IMPAIRED = ("links.delay_s=0.1", "links.loss=0.3")
ESTIMATE = "controller.disturbance.estimate=true"
HEAVIER = "plant.payload_mass_factor"
UNKNOWN_DRAG = "controller.knows_drag=false"
MUJOCO, CABLES = "plant.engine=mujoco", "plant.mujoco.suspension=cables"
DETAILS = {
    "result": outcome,
    "mean cost": COST,
    "payload attitude": ATTITUDE,
    "smallest distance of two UAVs": cell("separation_min_m", "{:.2f} m", of=np.min),
    "largest distance of a UAV from its reference": cell("uav_max_m", "{:.2f} m"),
}


# docs/record/guarantees.md

NETWORKS = {
    "perfect": (),
    "200 ms delay": ("links.delay_s=0.2",),
    "30 % packet loss": ("links.loss=0.3",),
    "agents 1, 2 cut off from 3, 4 from 8 to 12 s": (
        'links.partition=[{between=["agent1","agent2"],start_s=8.0,end_s=12.0}]',
    ),
    "no plan arrives (`links.loss=1`)": ("links.loss=1",),
}


def killed(*agents: int, at_s: float = 8.0, settings: tuple[str, ...] = ()) -> Run:
    """Return the run in which agents are killed for good."""
    return Run(
        "resilient", (*events(*((at_s, "kill", f"agent{agent}") for agent in agents)), *settings)
    )


def returning(at_s: float, scenario: str = "resilient") -> Run:
    """Return the run in which agent 3 is killed at 8 s and restarted."""
    return Run(scenario, events((8.0, "kill", "agent3"), (at_s, "restart", "agent3")))


def failed(uavs: int, **actions_s: float) -> Run:
    """Return the run of a team of some size in which UAV 3 fails."""
    return Run(
        "resilient",
        events(*((s, do, "uav3") for do, s in actions_s.items())),
        None if uavs == 4 else uavs,
    )


LEVEL = ("controller.fail_safe=level",)
DEATHS = {
    **{f"3, at {at_s:g} s": killed(3, at_s=at_s) for at_s in (1.0, 8.0, 16.0)},
    "3 and 4 (neighbours), at 8 s": killed(3, 4),
    "1 and 3 (opposite), at 8 s": killed(1, 3),
    "1, 2 and 3, at 8 s": killed(1, 2, 3),
    "3, at 8 s, `fail_safe=level`": killed(3, settings=LEVEL),
    "1 and 3, at 8 s, `fail_safe=level`": killed(1, 3, settings=LEVEL),
}
RETURNS = {
    **{f"{back_s:g} s": returning(back_s) for back_s in (8.5, 9.0, 10.0, 12.0, 17.0)},
    "never": killed(3),
    "10 s, `paper`": returning(10.0, "paper"),
}


def without(sensors: tuple[str, ...], uavs: tuple[int, ...], lasting_s: float | None) -> Run:
    """Return the run of `precise` with a filter in which sensors of UAVs fail at 8 s."""
    lasting = "" if lasting_s is None else f",duration_s={lasting_s}"
    names = ",".join(f'"{sensor}"' for sensor in sensors)
    outages = [
        f"{{at_s=8.0,do='sensors_off',target='uav{uav}',sensors=[{names}]{lasting}}}"
        for uav in uavs
    ]
    return Run("precise", (*SENSORS, f"faults.event=[{','.join(outages)}]"))


TEAM = (1, 2, 3, 4)
NAVIGATION = ("position", "velocity")
OUTAGES = {
    "none": Run("precise", SENSORS),
    "position of UAV 2, 10 s": without(("position",), (2,), 10.0),
    "position of UAV 2, for good": without(("position",), (2,), None),
    "position of UAV 2 to 4, for good": without(("position",), (2, 3, 4), None),
    "position and velocity of UAV 2, for good": without(NAVIGATION, (2,), None),
    "position of all, 3 s": without(("position",), TEAM, 3.0),
    "position and velocity of all, 3 s": without(NAVIGATION, TEAM, 3.0),
    "attitude of UAV 2, for good": without(("attitude",), (2,), None),
    "body rates of UAV 2, for good": without(("rate",), (2,), None),
    "specific force of UAV 2, for good": without(("specific_force",), (2,), None),
    "all sensors of UAV 2, for good": without(
        (*NAVIGATION, "attitude", "rate", "specific_force"), (2,), None
    ),
}
# Runs of four, five and six UAVs.
FAILURES = {
    "released at once": [failed(4, release=8.0), None, failed(6, release=8.0)],
    "motors off, released 0.1 s later": [failed(4, motor_off=8.0, release=8.1), None, None],
    "motors off, released 0.5 s later": [failed(4, motor_off=8.0, release=8.5), None, None],
    "motors off, never released": [failed(uavs, motor_off=8.0) for uavs in (4, 5, 6)],
}
GUARANTEES = (
    listed(
        "network",
        "network",
        {text: Run("resilient", settings) for text, settings in NETWORKS.items()},
        DETAILS,
    ),
    grid(
        "failures",
        ["permanent failure of UAV 3"],
        [f"{uavs} UAVs" for uavs in (4, 5, 6)],
        FAILURES,
        unless_diverged(ATTITUDE),
    ),
    listed("killed", "agent killed", DEATHS, DETAILS),
    listed("returns", "restarted at", RETURNS, DETAILS),
    listed(
        "outages",
        "sensors that fail at 8 s",
        OUTAGES,
        {
            "result": outcome,
            "payload error": cell("payload_rms_m", "{:.1f} cm rms", 100.0),
            "payload attitude": ATTITUDE,
        },
    ),
)


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


# docs/record/results.md

DEATH = events((8.0, "kill", "agent3"))
AGILE: Mapping[str, tuple[str, ...]] = {
    "200 ms delay, 30 % loss": LATE,
    "400 ms delay, 60 % loss": ("links.delay_s=0.4", "links.loss=0.6"),
    "perfect network": (),
    "one agent for all UAVs": ("agents.owned=[[1,2,3]]",),
    "5.5 m/s, 8.1 m/s², late": (*LATE, "maneuver.phase.2.speed_mps=5.5"),
    "payload 43 % heavier, estimated, late": (*LATE, ESTIMATE, f"{HEAVIER}=1.43"),
    "wind of 5 m/s, estimated, late": (*LATE, ESTIMATE, "plant.wind.speed_mps=[5.0,0.0,0.0]"),
    "agent 3 dies, late": (*LATE, *DEATH),
    "5 s without any message, late": (
        *LATE,
        "links.change=[{at_s=8.0,loss=1.0},{at_s=13.0,loss=0.3}]",
    ),
    "half the known drag, estimated, late": (*LATE, ESTIMATE, "plant.drag_factor=0.5"),
    "1.5 times the known drag, estimated, late": (*LATE, ESTIMATE, "plant.drag_factor=1.5"),
    "1.5 times the known drag, late": (*LATE, "plant.drag_factor=1.5"),
    "unknown drag, estimated, late": (*LATE, ESTIMATE, UNKNOWN_DRAG),
    "unknown drag, late": (*LATE, UNKNOWN_DRAG),
    "the engine MuJoCo, late": (*LATE, MUJOCO),
}
GAP = {
    "the scenario, 20 seeds": Run("gap", seeds=20),
    "perfect network, 5 seeds": Run("gap", ("links.delay_s=0.0", "links.loss=0.0"), seeds=5),
    "gusts of 1.5 m/s, estimated, 5 seeds": Run(
        "gap", ("plant.wind.gust_mps=[1.5,1.5,1.5]", ESTIMATE), seeds=5
    ),
}


def least(name: str) -> Cell:
    """Return the smallest distance of all seeds from the walls."""
    return cell(name, "{:.1f}", 100.0, np.min)


# The map of the claims: weights on attitude (that on positions is 1), terminal weights, horizons.
ATTITUDES, TERMINALS, HORIZONS = (0.5, 1.0, 5.0), (10.0, 50.0, 100.0), (6, 8, 10, 14)
KINDS = (("centralized", 0.05), ("paper", 0.05), ("paper", 0.04))
# "Slightly worse" and "slightly better" in the paper's claims: relative differences of the mean cost.
SLIGHTLY = (0.005, 0.1)


def kinds(attitude: float, terminal: float, horizon: int) -> list[Run]:
    """Return the runs of a point.

    Both controllers at 50 ms, the paper's at 40 ms with a horizon as long in seconds.
    """
    weights = (f"controller.weights.attitude={attitude}", f"controller.weights.terminal={terminal}")
    return [
        Run(
            name,
            (
                *weights,
                f"controller.horizon={round(horizon * 0.05 / s)}",
                f"controller.sampling_period_s={s}",
            ),
        )
        for name, s in KINDS
    ]


def ratios(index: int, *results: Flown) -> str:
    """Return the paper's costs over that of the centralized controller, bold where both claims hold."""
    (reference,), *own = (
        values("cost_mean", flown) for flown in results[len(KINDS) * index :][: len(KINDS)]
    )
    found = [costs[0] / reference if costs else math.inf for costs in own]
    text = ", ".join("diverges" if ratio == math.inf else f"{ratio:.3f}" for ratio in found)
    least, most = SLIGHTLY
    same_rate, same_computation = found
    both_hold = least < same_rate - 1.0 <= most and least <= 1.0 - same_computation < most
    return f"**{text}**" if both_hold else text


RESULTS = (
    Table(
        "claims",
        ["attitude, Q_f"],
        {
            f"{attitude:g}, {terminal:g}": [
                run for N_p in HORIZONS for run in kinds(attitude, terminal, N_p)
            ]
            for attitude, terminal in product(ATTITUDES, TERMINALS)
        },
        {f"N_p {N_p}": partial(ratios, i) for i, N_p in enumerate(HORIZONS)},
    ),
    listed(
        "gap",
        "case",
        GAP,
        {
            "completed": completed,
            "UAVs, cm": least("uav"),
            "rods, cm": least("rod"),
            "payload, cm": least("payload"),
            "worst error rms, cm": cell("payload_rms_m", "{:.2f}", 100.0, np.max),
        },
    ),
    listed(
        "fast",
        "case",
        {text: Run("eight", settings, seeds=10) for text, settings in AGILE.items()},
        {
            "completed": completed,
            "error rms, mean, cm": interval("payload_rms_m", 2, 100.0),
            "worst rms, cm": cell("payload_rms_m", "{:.2f}", 100.0, np.max),
            "largest error, cm": cell("payload_max_m", "{:.1f}", 100.0, np.max),
            "attitude, deg": cell("attitude_max_deg", "{:.1f}", of=np.max),
        },
    ),
)


# docs/record/radio.md

ON_CHANGE = "controller.share=on_change"
FLIGHTS: Mapping[str, tuple[int | None, tuple[str, ...]]] = {
    "4 UAVs, no radio": (None, ()),
    "4 UAVs, 6 Mb/s": (None, ("radio={}",)),
    "4 UAVs, 6 Mb/s, on change": (None, ("radio={}", ON_CHANGE)),
    "16 UAVs, no radio": (16, ()),
    "16 UAVs, 24 Mb/s": (16, ("radio={rate_mbps=24.0}",)),
    "16 UAVs, 6 Mb/s, on change": (16, ("radio={}", ON_CHANGE)),
    "32 UAVs, 24 Mb/s": (32, ("radio={rate_mbps=24.0}",)),
    "32 UAVs, 6 Mb/s, on change": (32, ("radio={}", ON_CHANGE)),
}
RADIO = (
    listed(
        "flights",
        "`resilient`",
        {text: Run("resilient", settings, uavs) for text, (uavs, settings) in FLIGHTS.items()},
        {
            "result": outcome,
            "mean cost": COST,
            "airtime": cell("airtime_share", "{:.1f} %", 100.0),
            "delivered": cell("air_delivered_share", "{:.1f} %", 100.0),
            "delay, 99th percentile": cell("air_delay_p99_ms", "{:.2f} ms"),
            "largest payload error": cell("payload_max_m", "{:.1f} cm", 100.0),
        },
    ),
)

PAGES = {
    "record/guarantees.md": GUARANTEES,
    "record/engines.md": ENGINES,
    "record/values.md": VALUES,
    "record/measured.md": (*SCENARIO, *TIME),
    "record/results.md": RESULTS,
    "record/radio.md": RADIO,
}
