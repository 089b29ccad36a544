"""Tables that are made from the results of others: those of README, and the network and the claim at a glance."""

from collections.abc import Mapping, Sequence

from measured import Derived
from readme_tables import drag, known
from results_page import PAGE, PAPER, ranges_of_comparison, rows_of
from tables import ROOT, table

from transport.experiments.simulation import Result

README = ROOT / "README.md"

Row = Mapping[str, str]  # of points.csv


def between(values: Sequence[float]) -> str:
    """Return the range of values, two digits each; a single value if both ends round to the same."""
    return " to ".join(dict.fromkeys(f"{end:.2f}" for end in (min(values), max(values))))


# Rows of the table on the network at a glance: text, experiment, and labels of the points.
GLANCE: Sequence[tuple[str, str, Row]] = (
    ("`transport experiment latency`: 100 ms delay", "latency", {"delay_s": "0.1"}),
    ("400 ms delay", "latency", {"delay_s": "0.4"}),
    (
        "`transport experiment loss`: 10 % packet loss",
        "loss",
        {"loss": "0.1", "model": "bernoulli"},
    ),
    ("60 % burst loss", "loss", {"loss": "0.6", "model": "bursts"}),
    (
        "`transport experiment kill`: an agent killed and restarted after 2 s",
        "kill",
        {"restart_s": "10.0"},
    ),
    ("never restarted", "kill", {"restart_s": "never"}),
    ("`transport experiment deaths`: killed for good at 20 random times", "deaths", {}),
)


def at_a_glance(results: Mapping[str, Sequence[Result]]) -> str:
    """Return the table at a glance: effect of the network on the two algorithms."""
    tables = {name: rows_of(name, own) for name, own in results.items()}
    rows = [
        [
            text,
            *(effect_of(tables[name], {"scenario": scenario, **labels}) for scenario in SCENARIOS),
        ]
        for text, name, labels in GLANCE
    ]
    return table(["", "`paper`: the paper's algorithm with our weights", "`resilient`"], rows)


SCENARIOS = ("paper", "resilient")


def effect_of(rows: Sequence[Row], labels: Row) -> str:
    """Return how the runs with some labels end, in words; ranges are over the points of the experiment."""
    own = [row for row in rows if row.items() >= labels.items() and row.get("agent") != "none"]
    if not own:
        return ""
    runs = sum(int(row["flights"]) for row in own)
    completed = sum(int(row["completed"]) for row in own)
    if not completed:
        first_s = min(float(row["first_lost_s"]) for row in own)
        return f"{completed} of {runs} complete, the first diverges at {first_s:.1f} s"

    done = [row for row in own if row["cost_ratio"]]
    if not done:
        return f"{completed} of {runs} complete"
    ratios = [float(row["cost_ratio"]) for row in done]
    attitude_deg = max(float(row["attitude_max_deg"]) for row in done)
    swings_m = [float(row["swing_m"]) for row in done]
    effect = (
        f"cost x{between(ratios)}, attitude {attitude_deg:.1f} deg, swing {between(swings_m)} m"
    )
    return f"{completed} of {runs} complete: {effect}"


def claim(results: Mapping[str, Sequence[Result]]) -> str:
    """Return the table of the paper's algorithm against the centralized controller, a row for each comparison."""
    rows = [
        row
        for row in ranges_of_comparison(results[PAPER])
        if row["controller"] == "paper's algorithm"
    ]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    cells = {(row["at"], row["weather"]): row["cost"] or row["T_s"] for row in rows}
    periods: dict[str, str] = {}  # of each comparison of costs, in the first weather
    for row in rows:
        periods.setdefault(row["at"], f" (T_s {row['T_s']})" if row["cost"] else "")
    lines = [
        [f"at {at}{period}", *(cells[at, weather] for weather in weathers)]
        for at, period in periods.items()
    ]
    return table(["the paper's algorithm with our weights", *weathers], lines)


DERIVED = (
    Derived(
        name="drag",
        document=README,
        sources=("fast",),
        text=lambda results: drag(results["fast"]),
    ),
    Derived(
        name="known",
        document=README,
        sources=("information",),
        text=lambda results: known(rows_of("information", results["information"])),
    ),
    Derived(
        name="network",
        document=PAGE,
        sources=("latency", "loss", "kill", "deaths"),
        text=at_a_glance,
    ),
    Derived(name="claim", document=PAGE, sources=(PAPER,), text=claim),
)
