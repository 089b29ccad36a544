"""Renew the measured tables of docs/engines.md: part of `make figures`, five minutes on two cores."""

import time
from collections.abc import Mapping, Sequence
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import numpy as np
from simulations import Flown, Measured, Run, cost, renew
from tables import ROOT, table

from plant.engines import Engine, engine_version
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized
from transport.interface.fly import fly

DOCUMENT = ROOT / "docs" / "engines.md"

ENGINE = "plant.engine"
LATE = ("links.delay_s=0.2", "links.loss=0.3")
NETWORKS: Mapping[str, tuple[str, ...]] = {"perfect": (), "200 ms delay, 30 % packet loss": LATE}

# Suspensions of the load, as settings of MuJoCo.
SUSPENSIONS: Mapping[str, Mapping[str, Any]] = {
    "rods of 1 g": {},
    "rods of 10 g": {"plant.mujoco.rod_mass_kg": 0.01},
    "rods of 100 g": {"plant.mujoco.rod_mass_kg": 0.1},
    "rods of 100 g, with `controller.disturbance.estimate`": {
        "plant.mujoco.rod_mass_kg": 0.1,
        "controller.disturbance.estimate": True,
    },
    "cables": {"plant.mujoco.suspension": "cables"},
}

# Runs with body rates, and the inner loops that are compared in them.
DEATH = ("clock.on_agent_loss=continue", 'faults.event=[{at_s=8.0,do="kill",target="agent3"}]')
SENSORS = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "plant.noise={position_m=0.01,velocity_mps=0.02,attitude_rad=0.0087,rate_rads=0.0175,specific_force_mps2=0.3}",
)
LOOPS = ("model", "betaflight")
FIRMWARE: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("resilient", "perfect network"): (),
    ("resilient", "motor lag of 50 ms (`plant.motors.lag_s=0.05`)"): ("plant.motors.lag_s=0.05",),
    ("resilient", "in MuJoCo"): (f"{ENGINE}=mujoco",),
    ("resilient", "200 ms delay, 30 % packet loss"): LATE,
    ("resilient", "the same, agent 3 killed at 8 s for good"): (*LATE, *DEATH),
    ("precise", "perfect network"): (),
    ("precise", "200 ms delay, 30 % packet loss"): LATE,
    ("precise", "the same, agent 3 killed at 8 s for good"): (*LATE, *DEATH),
    ("precise", "200 ms delay, 30 % packet loss, no sensor at the payload, noise"): (*LATE, *SENSORS),
    ("eight", "as it is"): (),
}

# The delivery without its release, held for long; it lands at the end of this phase, counted from 1.
HELD, LANDED = {"faults.event": [], "maneuver.phase.5.duration_s": 10.0}, 4

# Speed: periods of the maneuver's hover, integrated and read out, by teams of these sizes.
TEAMS, PERIODS, REPETITIONS = (2, 4, 8), 100, 5


def errors(result: Flown) -> str:
    """Return outcome and payload errors."""
    outcome = "completes" if result.completed else f"**diverged** at {result.lost_s:.1f} s"
    return f"{outcome}, {result.payload_rms_m * 100:.2f} cm rms, {result.payload_max_m * 100:.2f} cm"


def deliveries(_: str, results: Sequence[Flown]) -> list[str]:
    """Return number of completed deliveries, and distances of the payload from its target."""
    ends_cm = [100.0 * result.payload_last_m for result in results if result.completed]
    cells = [f"{np.median(ends_cm):.1f} cm", f"{max(ends_cm):.1f} cm"] if ends_cm else ["", ""]
    return [f"{len(ends_cm)} of {len(results)}", *cells]


def compared(_: str, modelled: Flown, firmware: Flown) -> list[str]:
    """Return the costs with the modelled inner loop and with firmwares, and their ratio."""
    costs = [cost(each) if each.completed else f"**diverged** at {each.lost_s:.1f} s" for each in (modelled, firmware)]
    both = modelled.completed and firmware.completed
    return [*costs, f"{firmware.cost_mean / modelled.cost_mean:.2f}" if both else ""]


def suspensions() -> str:
    """Return the table of rods of several masses and cables, against massless rods."""
    massless = fly("resilient", progress=False).series["payload_position_m"]
    rows = []
    for name, changes in SUSPENSIONS.items():
        run = fly("resilient", {ENGINE: "mujoco", **changes}, progress=False)
        own, tracking = run.series["payload_position_m"], run.summary["payload_tracking"]
        apart_m = np.linalg.norm(own - massless[: len(own)], axis=1).max()
        found = {f"payload_{name}": value for name, value in tracking.items()}
        result = SimpleNamespace(completed=run.completed, lost_s=run.summary["sim_time_s"], **found)
        rows.append([name, f"{apart_m * 1e3:.1f} mm", errors(result)])
    return table(["`resilient` in MuJoCo with", "largest distance to the path of massless rods", "payload error"], rows)


def cables() -> str:
    """Return the table of flights on cables, some with a UAV that is almost without thrust for a moment."""
    rows = []
    for name, changes in CABLES.items():
        run = fly(
            name.split("`")[1], {ENGINE: "mujoco", "plant.mujoco.suspension": "cables", **changes}, progress=False
        )
        found, payload = run.summary["cables"], run.series["payload_error_m"]
        slack = f"{found['slack']} times, up to {found['slack_longest_s']:.2f} s" if found["slack"] else "never"
        error, end = 100.0 * run.summary["payload_tracking"]["max_m"], 100.0 * np.linalg.norm(payload[-1])
        rows.append([name, run.outcome, f"{found['tension_min_N']:.2f} N", slack, f"{error:.1f} cm", f"{end:.1f} cm"])
    return table(
        ["on cables", "run", "smallest tension", "slack", "payload error, largest", "at the end"],
        rows,
    )


def dip(at_s: float, duration_s: float, share: float) -> dict[str, Any]:
    """Return the fault of a UAV that has a share of its thrust and moments for some time."""
    events = ((at_s, share), (at_s + duration_s, 1.0))
    return {"faults.event": [{"at_s": t, "do": "degrade", "target": "uav2", "efficiency": e} for t, e in events]}


def fall(depth_m: float) -> dict[str, Any]:
    """Return a maneuver that descends almost as fast as bodies fall, in a second."""
    ways = (("hover", 1.0, 0.0), ("descend", 1.0, depth_m), ("hover", 3.0, 0.0))
    phases = [{"name": name, "duration_s": s, "displacement_m": [0.0, 0.0, down]} for name, s, down in ways]
    return {"maneuver.phase": phases}


TAUT = {"controller.tension.minimum_N": 2.0}
IMPAIRED = {"links.delay_s": 0.2, "links.loss": 0.3}
SLOWER = {"maneuver.phase.2.speed_mps": 3.0, **IMPAIRED}
CABLES: Mapping[str, Mapping[str, Any]] = {
    "`resilient`": {},
    "`eight` at 5 m/s, 200 ms delay, 30 % packet loss": IMPAIRED,
    "`eight` at 3 m/s, the same network": SLOWER,
    "`resilient`, UAV 2 with 5 % of its thrust for 0.15 s": dip(8.0, 0.15, 0.05),
    "`eight` at 3 m/s, the same network, UAV 2 with 5 % of its thrust for 0.15 s": {**SLOWER, **dip(10.0, 0.15, 0.05)},
    "`eight` at 3 m/s, the same network, UAV 2 with 30 % of its thrust for 0.3 s": {**SLOWER, **dip(10.0, 0.3, 0.3)},
    "`resilient`, 6 m down in 1 s": fall(6.0),
    "`resilient`, the same, with `controller.tension.minimum_N=2`": {**fall(6.0), **TAUT},
    "`precise`, 7 m down in 1 s": fall(7.0),
    "`precise`, the same, with `controller.tension.minimum_N=2`": {**fall(7.0), **TAUT},
}


def held() -> str:
    """Return the sentence about a team that stays on its rods above a payload on the ground."""
    run = fly("delivery", HELD, progress=False)
    if run.completed:
        return "Without the release the team stands above the payload until the end of the run, 10 s after the landing."
    landed_s = sum(phase.duration_s for phase in run.scenario.setup.maneuver.phases[:LANDED])
    end_s = run.summary["sim_time_s"]
    return f"Without the release the run ends as {run.outcome} {end_s - landed_s:.1f} s after the landing."


def speed() -> str:
    """Return the table of the speed of each engine, alone, for several teams."""
    rows = [[f"`{name}`", *(f"{factor(name, uavs):.0f}" for uavs in TEAMS)] for name in ("rods", "mujoco")]
    return table(["simulated time over processor time", *(f"{uavs} UAVs" for uavs in TEAMS)], rows)


def factor(engine_name: str, uavs: int) -> float:
    """Return simulated time over the smallest processor time of some repetitions, from the initial state on."""
    path = find_scenario("resilient")
    scenario = read_scenario(path, [f"{ENGINE}={engine_name}"])
    setup = Setup.of(resized(scenario, path.parent, uavs, group=None, name=None, source=str(path)), "resilient")
    engine, period_s = Engine(setup, setup.system), setup.settings.sampling_period_s
    engine.warm_up(setup)
    times_s = []
    for _ in range(REPETITIONS):
        begun_s = time.process_time()
        engine.reset(setup.initial_state())
        for _ in range(PERIODS):
            engine.advance(setup.hover.u, None, period_s)
        times_s.append(time.process_time() - begun_s)
    return PERIODS * period_s / min(times_s)


TABLES = (
    Measured(
        "controllers",
        ["scenario", "network", "`rods`: payload error", "`mujoco`: payload error"],
        {
            (f"`{name}`", network): [Run(name, settings), Run(name, (f"{ENGINE}=mujoco", *settings))]
            for name in ("resilient", "precise")
            for network, settings in NETWORKS.items()
        },
        lambda _, *results: [errors(result) for result in results],
    ),
    Measured(
        "deliveries",
        ["`delivery`, seeds 0 to 9", "completed", "distance of the payload from its target, median", "largest"],
        {"noise of `windy`": [Run("delivery", seeds=10)]},
        deliveries,
    ),
    Measured(
        "firmware",
        ["scenario", "settings", "modelled", "Betaflight", "ratio"],
        {
            (f"`{name}`", what): [
                Run(name, ("controller.inputs=rates", f"plant.inner_loop={loop}", *settings)) for loop in LOOPS
            ]
            for (name, what), settings in FIRMWARE.items()
        },
        compared,
    ),
)
TEXTS = {"suspensions": suspensions, "cables": cables, "speed": speed, "held": held}


if __name__ == "__main__":
    versions = f", mujoco {engine_version('mujoco')}, betaflight {metadata.version('betaflight')}"
    renew(DOCUMENT, TABLES, TEXTS, versions)
