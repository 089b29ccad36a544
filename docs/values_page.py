"""Renew the measured tables of docs/values.md: part of `make figures`, three minutes on two cores."""

from collections.abc import Callable, Sequence
from functools import partial

from simulations import Flown, Measured, Run, attitude, cost, each, number, or_diverged, renew, significant
from tables import ROOT

DOCUMENT = ROOT / "docs" / "values.md"

IMPAIRED = ("links.delay_s=0.1", "links.loss=0.3")
COMPARED = ("paper", "centralized", "resilient", "centralized_lq", "precise")
SCALE = 128.0
ESTIMATE = "controller.disturbance.estimate=true"


def length(value_m: float) -> str:
    """Return a length in cm or mm, without insignificant digits."""
    if value_m < 1e-5:
        return "below 0.01 mm"
    return f"{100 * value_m:.1f} cm" if value_m >= 0.01 else f"{1e3 * value_m:.2f} mm"


def compared(name: str, cells: dict[str, Callable[[Flown], str]], settings: tuple[str, ...] = ()) -> Measured:
    """Return a table with a row for each quantity and a column for each scenario."""
    runs = [Run(scenario, settings) for scenario in COMPARED]
    return Measured(
        name,
        ["", *(f"`{scenario}`" for scenario in COMPARED)],
        dict.fromkeys(cells, runs),
        lambda text, *results: [or_diverged(result, cells[text]) for result in results],
    )


FOLLOWS: dict[str, Callable[[Flown], str]] = {
    "cost of a tick, mean": cost,
    "cost of a tick, largest": lambda result: significant(result.cost_max),
    "payload attitude, largest": attitude,
    "UAV position error, rms": lambda result: f"{100 * result.uav_rms_m:.1f} cm",
    "payload position error, rms": lambda result: f"{100 * result.payload_rms_m:.1f} cm",
    "payload position error, largest": lambda result: f"{100 * result.payload_max_m:.1f} cm",
    "the same in the last 4 s": lambda result: f"{100 * result.swing_m:.1f} cm",
    "smallest distance of two UAVs": lambda result: f"{result.separation_min_m:.3f} m",
}

# The paper's level, and ours, of each quantity.
LEVELS: dict[str, tuple[str, Callable[[Flown], str]]] = {
    "cost of a tick after the first hover, largest": ("3", lambda result: number(SCALE * result.cost_max_settled)),
    "factor at which that is 3": ("", lambda result: number(3.0 / result.cost_max_settled, 0)),
    "payload attitude, largest": ("2.5 deg", attitude),
}

WEIGHTS = (
    "controller.weights.attitude=0.5",
    "controller.weights.attitude=50",
    "controller.weights.acceleration=5e-4",
    "controller.weights.acceleration=5e-2",
    "controller.weights.angular_acceleration=1.7e-4",
    "controller.weights.angular_acceleration=1.7e-2",
    "controller.weights.terminal=1",
    "controller.weights.terminal=25",
    "controller.horizon=5",
    "controller.horizon=10",
    "controller.horizon=30",
    "maneuver.profile=min_jerk",
    "maneuver.profile=step",
)


def changed(setting: str) -> list[Run | None]:
    """Return the runs with one setting changed in `paper` and `resilient`; None where it has no effect."""
    without_effect = setting.startswith("controller.weights.terminal")  # `resilient` has the cost-to-go
    return [Run("paper", (setting,)), None if without_effect else Run("resilient", (setting,))]


PLANTS = {"15 % more payload": "plant.payload_mass_factor=1.15", "wind of 5 m/s": "plant.wind.speed_mps=[5,0,0]"}
STILL = "maneuver.phase=[{name='hover',duration_s=20,displacement_m=[0,0,0]}]"
ESTIMATES = {
    "without estimate": (),
    "with estimate": (ESTIMATE,),
    "with estimate, 100 ms delay, 30 % loss": (ESTIMATE, *IMPAIRED),
}

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


def collision(_: str, result: Flown) -> list[str]:
    """Return distance, place and attitude."""
    if not result.completed:
        return [or_diverged(result, attitude), "", ""]
    return [f"{result.separation_min_m:.3f} m", f"{result.front_m:.3f} m", attitude(result)]


WINDY: Sequence[tuple[str, tuple[str, ...], int]] = (
    ("as it is", (), 16),
    ("as it is", (), 8),
    ("without the estimate", ("controller.disturbance.estimate=false",), 8),
    ("100 ms delay, 30 % loss", IMPAIRED, 8),
    ("a tenth of the weight on moments", ("controller.weights.angular_acceleration=1.7e-4",), 8),
    (
        "open-loop prediction",
        ("controller.prediction=open_loop", "controller.terminal=multiple", "controller.preview=false"),
        8,
    ),
)


def windy(_: str, results: Sequence[Flown]) -> list[str]:
    """Return the cells of runs in wind: smallest, mean and largest value over the seeds."""
    there = [result for result in results if result.completed]
    count = f"{len(there)} of {len(results)}"
    if not there:
        return [count, *[""] * 4]

    def spread(values: Sequence[float], text: Callable[[float], str]) -> str:
        return " / ".join(text(value) for value in (min(values), sum(values) / len(values), max(values)))

    return [
        count,
        spread([result.attitude_max_deg for result in there], number),
        spread([result.cost_mean for result in there], partial(significant, digits=2)),
        f"{min(result.separation_min_m for result in there):.2f}",
        f"{max(result.swing_m for result in there):.2f}",
    ]


TABLES = (
    compared("follows", FOLLOWS),
    Measured(
        "levels",
        ["weights times 128", "the paper", "`centralized`", "`paper`"],
        {text: [Run("centralized"), Run("paper")] for text in LEVELS},
        lambda text, *results: [LEVELS[text][0], *map(LEVELS[text][1], results)],
    ),
    Measured(
        "weights",
        ["`--set`", "`paper`", "`resilient`"],
        {"nothing": [Run("paper"), Run("resilient")], **{f"`{setting}`": changed(setting) for setting in WEIGHTS}},
        each(lambda result: or_diverged(result, lambda f: f"{attitude(f)}, {100 * f.swing_m:.0f} cm"), "no effect"),
    ),
    compared(
        "hover",
        {
            "payload attitude, largest": attitude,
            "payload position error, last 4 s": lambda result: length(result.swing_m),
        },
        ("maneuver.phase.5.duration_s=60",),
    ),
    Measured(
        "plant_state",
        ["", *ESTIMATES],
        {
            text: [Run("resilient", (STILL, setting, *changes)) for changes in ESTIMATES.values()]
            for text, setting in PLANTS.items()
        },
        each(lambda result: or_diverged(result, lambda f: f"{length(f.uav_last_m)}, {cost(f)}")),
    ),
    Measured(
        "collision",
        ["", "smallest distance", "front pair, largest x", "payload attitude, largest"],
        {text: [Run("collision", settings)] for text, settings in COLLISION.items()},
        collision,
    ),
    Measured(
        "windy",
        ["", "seeds", "completed", "payload attitude, deg", "mean cost", "smallest distance, m", "swing, m"],
        {(text, f"0 to {seeds - 1}"): [Run("windy", settings, seeds=seeds)] for text, settings, seeds in WINDY},
        windy,
    ),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
