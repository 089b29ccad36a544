"""Renew the measured tables of docs/values.md: part of `make figures`, three minutes on two cores."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from simulations import Found, Measured, Result, Run, attitude, cost, number, one, or_diverged, renew, significant
from tables import ROOT, table

DOCUMENT = ROOT / "docs" / "values.md"

IMPAIRED = ("links.delay_s=0.1", "links.loss=0.3")
LONG_HOVER = "maneuver.phase.5.duration_s=60"


# Collision: setting, and its text.
COLLISION = {
    "as it is": (),
    "`controller.separation.minimum_m=0.001`": ("controller.separation.minimum_m=0.001",),
    "`agents.owned=[[1,2,3,4]]`": ("agents.owned=[[1,2,3,4]]",),
    "all three penalties 60": (
        "controller.separation.penalty=60",
        "controller.constraint.1.penalty=60",
        "controller.constraint.2.penalty=60",
    ),
}


def collision(found: Found) -> str:
    """Return the table of the collision."""
    rows = []
    for text, settings in COLLISION.items():
        result = one(found, Run("collision", settings))
        cells = [f"{result.separation_m:.3f} m", f"{result.front_m:.3f} m", attitude(result)]
        rows.append([text, *(cells if result.completed else [or_diverged(result, attitude), "", ""])])
    return table(["", "smallest distance", "front pair, largest x", "payload attitude, largest"], rows)


WINDY = (
    ("as it is", (), 16),
    ("as it is", (), 8),
    ("without the estimate", ("controller.disturbance.estimate=false",), 8),
    ("100 ms delay, 30 % loss", IMPAIRED, 8),
    ("weight of the moments of `resilient`", ("controller.weights.moments=[0.01,0.01,0.01]",), 8),
    (
        "open-loop prediction",
        ("controller.prediction=open_loop", "controller.terminal=multiple", "controller.preview=false"),
        8,
    ),
)


def windy(found: Found) -> str:
    """Return the table of the runs in wind."""
    rows = []
    for text, settings, seeds in WINDY:
        # The first seeds of the simulated ones.
        result = next(results for run, results in found.items() if run == _windy(settings))[:seeds]
        there = [f for f in result if f.completed]
        cells = [text, f"0 to {seeds - 1}", f"{len(there)} of {seeds}"]
        if there:
            cells += [
                _spread([f.attitude_deg for f in there], number),
                _spread([f.cost_mean for f in there], partial(significant, digits=2)),
                f"{min(f.separation_m for f in there):.2f}",
                f"{max(f.swing_m for f in there):.2f}",
            ]
        else:
            cells += [""] * 4
        rows.append(cells)
    headings = ["", "seeds", "completed", "payload attitude, deg", "mean cost", "smallest distance, m", "swing, m"]
    return table(headings, rows)


def _windy(settings: tuple[str, ...]) -> Run:
    return Run("windy", settings, seeds=max(seeds for _, own, seeds in WINDY if own == settings))


def _spread(values: Sequence[float], text: Callable[[float], str]) -> str:
    """Return smallest, mean and largest value."""
    return " / ".join(text(value) for value in (min(values), sum(values) / len(values), max(values)))


COMPARED = ("paper", "centralized", "resilient", "centralized_lq", "precise")


def _compared(found: Found, settings: tuple[str, ...], cells: Mapping[str, Callable[[Result], str]]) -> str:
    """Return a table with a row for each quantity and a column for each scenario."""
    runs = {name: Run(name, settings) for name in COMPARED}
    rows = [[text, *(or_diverged(one(found, run), cell) for run in runs.values())] for text, cell in cells.items()]
    return table(["", *(f"`{name}`" for name in runs)], rows)


def follows(found: Found) -> str:
    """Return the table of the ready scenarios of the paper's maneuver."""
    cells: dict[str, Callable[[Result], str]] = {
        "cost of a tick, mean": cost,
        "cost of a tick, largest": lambda result: significant(result.cost_max),
        "payload attitude, largest": attitude,
        "UAV position error, rms": lambda result: f"{100 * result.uav_rms_m:.1f} cm",
        "payload position error, rms": lambda result: f"{100 * result.payload_rms_m:.1f} cm",
        "payload position error, largest": lambda result: f"{100 * result.payload_max_m:.1f} cm",
        "the same in the last 4 s": lambda result: f"{100 * result.swing_m:.1f} cm",
        "smallest distance of two UAVs": lambda result: f"{result.separation_m:.3f} m",
    }
    return _compared(found, (), cells)


def hover(found: Found) -> str:
    """Return the table of a long hover after the maneuver."""
    swing = {"payload position error, last 4 s": lambda result: _length(result.swing_m)}
    return _compared(found, (LONG_HOVER,), {"payload attitude, largest": attitude, **swing})


SCALE = 128.0


def levels(found: Found) -> str:
    """Return the table of the paper's levels."""
    both = [one(found, Run(name)) for name in ("centralized", "paper")]
    rows = [
        ["cost of a tick after the first hover, largest", "3", *(number(SCALE * f.cost_max_settled) for f in both)],
        ["factor at which that is 3", "", *(number(3.0 / f.cost_max_settled, 0) for f in both)],
        ["payload attitude, largest", "2.5 deg", *map(attitude, both)],
    ]
    return table(["weights times 128", "the paper", "`centralized`", "`paper`"], rows)


WEIGHTS = (
    "controller.weights.attitude=0.5",
    "controller.weights.attitude=50",
    "controller.weights.thrust=1e-4",
    "controller.weights.thrust=1e-2",
    "controller.weights.moments=[1e-3,1e-3,1e-3]",
    "controller.weights.moments=[1e-1,1e-1,1e-1]",
    "controller.weights.terminal=1",
    "controller.weights.terminal=25",
    "controller.horizon=5",
    "controller.horizon=10",
    "controller.horizon=30",
    "maneuver.profile=min_jerk",
    "maneuver.profile=step",
)


def _changed(setting: str) -> list[Run | None]:
    """Return the runs with one setting changed in `paper` and `resilient`; None where it has no effect."""
    without_effect = setting.startswith("controller.weights.terminal")  # `resilient` has the cost-to-go
    return [Run("paper", (setting,)), None if without_effect else Run("resilient", (setting,))]


CHANGED = {"nothing": [Run("paper"), Run("resilient")], **{f"`{setting}`": _changed(setting) for setting in WEIGHTS}}


def weights(found: Found) -> str:
    """Return the table of the sensitivity to the weights."""

    def cell(run: Run | None) -> str:
        if run is None:
            return "no effect"
        return or_diverged(one(found, run), lambda f: f"{attitude(f)}, {100 * f.swing_m:.0f} cm")

    rows = [[text, *map(cell, runs)] for text, runs in CHANGED.items()]
    return table(["`--set`", "`paper`", "`resilient`"], rows)


PLANTS = {
    "15 % more payload": "plant.payload_mass_factor=1.15",
    "wind of 5 m/s": "plant.wind.speed_mps=[5,0,0]",
}
STILL = "maneuver.phase=[{name='hover',duration_s=20,displacement_m=[0,0,0]}]"
ESTIMATE = "controller.disturbance.estimate=true"
ESTIMATES: Mapping[str, tuple[str, ...]] = {
    "without estimate": (),
    "with estimate": (ESTIMATE,),
    "with estimate, 100 ms delay, 30 % loss": (ESTIMATE, *IMPAIRED),
}
UNMODELLED = {
    text: [Run("resilient", (STILL, setting, *changes)) for changes in ESTIMATES.values()]
    for text, setting in PLANTS.items()
}


def plant_state(found: Found) -> str:
    """Return the table of unmodelled mass and wind."""

    def cell(run: Run) -> str:
        return or_diverged(one(found, run), lambda f: f"{_length(f.uav_last_m)}, {cost(f)}")

    return table(["", *ESTIMATES], [[text, *map(cell, runs)] for text, runs in UNMODELLED.items()])


def _length(value_m: float) -> str:
    """Return a length in cm or mm, without insignificant digits."""
    if value_m < 1e-5:
        return "below 0.01 mm"
    return f"{100 * value_m:.1f} cm" if value_m >= 0.01 else f"{1e3 * value_m:.2f} mm"


TABLES = (
    Measured("follows", tuple(Run(name) for name in COMPARED), follows),
    Measured("levels", (Run("centralized"), Run("paper")), levels),
    Measured("weights", tuple(run for runs in CHANGED.values() for run in runs if run is not None), weights),
    Measured("hover", tuple(Run(name, (LONG_HOVER,)) for name in COMPARED), hover),
    Measured("plant_state", tuple(run for runs in UNMODELLED.values() for run in runs), plant_state),
    Measured("collision", tuple(Run("collision", settings) for settings in COLLISION.values()), collision),
    Measured("windy", tuple(dict.fromkeys(_windy(settings) for _, settings, _ in WINDY)), windy),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
