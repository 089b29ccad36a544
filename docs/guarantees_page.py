"""Renew the measured tables of docs/guarantees.md: part of `make figures`, four minutes on two cores."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from simulations import Found, Measured, Result, Run, cost, one, renew
from tables import ROOT, table

from transport.experiments.cases import Team

DOCUMENT = ROOT / "docs" / "guarantees.md"

NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": (),
    "200 ms delay": ("links.delay_s=0.2",),
    "30 % packet loss": ("links.loss=0.3",),
    "agents 1, 2 cut off from 3, 4 from 8 to 12 s": (
        'links.partition=[{between=["agent1","agent2"],start_s=8.0,end_s=12.0}]',
    ),
    "no plan arrives (`links.loss=1`)": ("links.loss=1",),
}


def outcome(result: Result) -> str:
    """Return how a run ended, and when if that was early."""
    return "completes" if result.completed else f"**diverges** at {result.end_s:.1f} s ({result.phase})"


def attitude(result: Result) -> str:
    """Return the largest payload attitude; empty for a run that diverged, where it has no meaning."""
    return f"{result.attitude_deg:.1f} deg" if result.completed else ""


def brief(result: Result) -> str:
    """Return outcome and payload attitude in one cell."""
    return f"completes, {attitude(result)}" if result.completed else f"**diverges** at {result.end_s:.1f} s"


def details(result: Result) -> list[str]:
    """Return the cells of a run below `DETAILS`."""
    if not result.completed:
        return [outcome(result), "", "", "", ""]
    distances = (result.separation_m, result.uav_max_m)
    return [outcome(result), cost(result), attitude(result), *(f"{distance:.2f} m" for distance in distances)]


DETAILS = (
    "result",
    "mean cost",
    "payload attitude",
    "smallest distance of two UAVs",
    "largest distance of a UAV from its reference",
)


def detailed(name: str, heading: str, runs: Mapping[str, Run]) -> Measured:
    """Return a table with a run in each row."""

    def text(found: Found) -> str:
        return table([heading, *DETAILS], [[row, *details(one(found, run))] for row, run in runs.items()])

    return Measured(name, tuple(runs.values()), text)


CONTINUE = "clock.on_agent_loss=continue"
KILLED_S = 8.0


def killed(
    scenario: str, *agents: int, at_s: float = KILLED_S, back_s: float | None = None, team: Team | None = None
) -> Run:
    """Return the run in which agents are killed and, unless `back_s` is None, restarted."""
    events = [f'{{at_s={at_s},do="kill",target="agent{agent}"}}' for agent in agents]
    if back_s is not None:
        events += [f'{{at_s={back_s},do="restart",target="agent{agent}"}}' for agent in agents]
    return Run(scenario, (CONTINUE, f"faults.event=[{','.join(events)}]"), team)


BACK_S = (8.5, 9.0, 10.0, 11.0, 12.0, 14.0, 17.0)
RETURNS = {f"{back_s:g} s": killed("resilient", 3, back_s=back_s) for back_s in BACK_S}
RETURNS |= {"never": killed("resilient", 3), "10 s, `paper`": killed("paper", 3, back_s=10.0)}


DEATHS = {
    **{f"{a}, at {at_s:g} s": killed("resilient", a, at_s=at_s) for at_s in (1.0, KILLED_S, 16.0) for a in (1, 3)},
    "3 and 4 (neighbours), at 8 s": killed("resilient", 3, 4),
    "1 and 3 (opposite), at 8 s": killed("resilient", 1, 3),
    "3, at 8 s, and a minimum distance of 1 mm": replace(
        killed("resilient", 3), settings=(*killed("resilient", 3).settings, "controller.separation.minimum_m=0.001")
    ),
}


ACTUATION = ("links.actuation.delay_s=0.05", "links.actuation.delay_s=0.1", "links.actuation.loss=0.3")
CLOCKS = ("immediate", "next_tick")


def _actuated(setting: str, clock: str) -> Run:
    # No setting of its own for the default: the same simulation as elsewhere.
    return Run("resilient", (setting,) if clock == "immediate" else (setting, f"clock.actuation={clock}"))


def actuation(found: Found) -> str:
    """Return the table of unmodelled actuator delay."""
    rows = []
    for setting in ACTUATION:
        row = [f"`{setting}`"]
        for clock in CLOCKS:
            result = one(found, _actuated(setting, clock))
            row.append(
                f"completes, {cost(result)}, {result.separation_m:.2f} m" if result.completed else outcome(result)
            )
        rows.append(row)
    return table(["`transport run resilient --set`", *(f"`{clock}`" for clock in CLOCKS)], rows)


def failed(uavs: int, *events: tuple[float, str], settings: tuple[str, ...] = ()) -> Run:
    """Return the run of a team of some size in which UAV 3 fails."""
    text = ",".join(f'{{at_s={at_s},do="{do}",target="uav3"}}' for at_s, do in events)
    return Run("resilient", (f"faults.event=[{text}]", *settings), None if uavs == 4 else Team(uavs, 1))


OFF, RELEASED = (KILLED_S, "motor_off"), (KILLED_S, "release")
LATE_AND_LOSSY = ("links.delay_s=0.2", "links.loss=0.3")
TEAMS = (4, 5, 6)
FAILURES: Mapping[str, Mapping[int, Run]] = {
    "agent killed (`kill` agent3, `clock.on_agent_loss=continue`), motors on": {
        4: killed("resilient", 3),
        6: killed("resilient", 3, team=Team(6, 1)),
    },
    "released at once": {uavs: failed(uavs, RELEASED) for uavs in (4, 6)},
    "the same with 200 ms delay and 30 % packet loss": {4: failed(4, RELEASED, settings=LATE_AND_LOSSY)},
    "motors off, released 0.1 s later": {4: failed(4, OFF, (8.1, "release"))},
    "motors off, released 0.5 s later": {4: failed(4, OFF, (8.5, "release"))},
    "motors off, never released": {uavs: failed(uavs, OFF) for uavs in TEAMS},
    "the same with 100 ms delay": {6: failed(6, OFF, settings=("links.delay_s=0.1",))},
}


def failures(found: Found) -> str:
    """Return the table of a UAV that fails."""
    rows = [
        [text, *(brief(one(found, runs[uavs])) if uavs in runs else "" for uavs in TEAMS)]
        for text, runs in FAILURES.items()
    ]
    return table(["permanent failure of UAV 3", *(f"{uavs} UAVs" for uavs in TEAMS)], rows)


SHORT = (
    'maneuver.phase=[{name="hover",duration_s=1.0,displacement_m=[0,0,0]},'
    '{name="climb",duration_s=3.0,displacement_m=[0,0,-1.5]},{name="translate",duration_s=3.0,displacement_m=[1.5,0,0]},'
    '{name="hover",duration_s=2.5,displacement_m=[0,0,0]}]'
)
INSTANTS: Mapping[float, str] = {
    0.9: "hover",
    2.0: "climb",
    3.5: "climb",
    4.0: "change from climb to translation",
    5.0: "translation",
    7.0: "change from translation to hover",
    7.5: "swing after the translation",
}


def _at(at_s: float) -> Run:
    return failed(6, (at_s, "motor_off"), settings=(SHORT,))


def instants(found: Found) -> str:
    """Return the table of six UAVs of which one fails at different times."""
    rows = [[f"{at_s:g} s", where, brief(one(found, _at(at_s)))] for at_s, where in INSTANTS.items()]
    return table(["motors off at", "during", "result"], rows)


LAGS_S = (0.02, 0.03, 0.035, 0.04, 0.05, 0.1)
KNOWN: Mapping[str, Callable[[float], tuple[str, ...]]] = {
    "unknown": lambda _: (),
    "unknown, `next_tick`": lambda _: ("clock.actuation=next_tick",),
    "known": lambda lag_s: (f"controller.motor_lag_s={lag_s:g}",),
    "assumed 50 ms": lambda _: ("controller.motor_lag_s=0.05",),
}


def _lagging(lag_s: float, known: str) -> Run:
    return Run("resilient", (f"plant.motors.lag_s={lag_s:g}", *KNOWN[known](lag_s)))


def _costly(result: Result) -> str:
    return f"completes, {cost(result)}" if result.completed else f"**diverges** at {result.end_s:.1f} s"


def lags(found: Found) -> str:
    """Return the table of motor lags."""
    rows = [
        [f"{1e3 * lag_s:g} ms", *(_costly(one(found, _lagging(lag_s, known))) for known in KNOWN)] for lag_s in LAGS_S
    ]
    return table(["`plant.motors.lag_s`", *KNOWN], rows)


ESTIMATES: Mapping[str, tuple[str, ...]] = {"no estimate": (), "estimate": ("controller.disturbance.estimate=true",)}
EFFICIENCIES = (0.9, 0.8, 0.6, 0.4)


def _degraded(efficiency: float, estimate: str) -> Run:
    event = f'{{at_s=10.0,do="degrade",target="uav3",efficiency={efficiency}}}'
    return Run("resilient", (f"faults.event=[{event}]", *ESTIMATES[estimate]))


def degraded(found: Found) -> str:
    """Return the table of a UAV whose motors degrade."""
    rows = []
    for efficiency in EFFICIENCIES:
        results = [one(found, _degraded(efficiency, estimate)) for estimate in ESTIMATES]
        rows.append([f"{efficiency:g}", *(f"{_costly(result)}, {attitude(result)}".rstrip(", ") for result in results)])
    return table(["efficiency of UAV 3 from 10 s on", *ESTIMATES], rows)


def _rotors(most_N: float) -> str:
    return f"plant.motors.rotors={{arm_m=0.25,drag_to_thrust_m=0.016,thrust_N=[0.0,{most_N:g}]}}"


LIMITED: Mapping[str, str] = {
    **{f"rotors with at most {most_N:g} N": _rotors(most_N) for most_N in (12.0, 6.0, 5.8, 5.7)},
    **{f"thrust in steps of {step_N:g} N": f"plant.motors.thrust_step_N={step_N:g}" for step_N in (0.1, 1.0, 8.0)},
}


TABLES = (
    detailed("network", "network", {text: Run("resilient", settings) for text, settings in NETWORKS.items()}),
    Measured("failures", tuple(run for runs in FAILURES.values() for run in runs.values()), failures),
    Measured("instants", tuple(map(_at, INSTANTS)), instants),
    detailed("deaths", "agent killed", DEATHS),
    detailed("returns", "restarted at", RETURNS),
    Measured("actuation", tuple(_actuated(setting, clock) for setting in ACTUATION for clock in CLOCKS), actuation),
    Measured("lags", tuple(_lagging(lag_s, known) for lag_s in LAGS_S for known in KNOWN), lags),
    Measured("degraded", tuple(_degraded(share, text) for share in EFFICIENCIES for text in ESTIMATES), degraded),
    detailed("limited", "motors", {text: Run("resilient", (setting,)) for text, setting in LIMITED.items()}),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
