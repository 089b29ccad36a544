"""The README's first tables: what becomes of the payload without a good network, or without any."""

from collections.abc import Mapping, Sequence

from tables import table

from transport.experiments.information_experiment import ALL, RULES
from transport.experiments.weather_experiment import NETWORKS, NONE, PERFECT

Row = Mapping[str, str]  # of points.csv
TEAM, ALONE, PAPER = "precise", "alone", "paper"


def worth(rows: Sequence[Row]) -> str:
    """Return the table of payload errors, a row for each weather, and a line about `paper`."""
    headings = [
        "payload error, rms",
        *(f"{network} network" if network == PERFECT else network for network in NETWORKS),
        "`alone`, no network",
    ]
    places = [*((TEAM, network) for network in NETWORKS), (ALONE, NONE)]
    lines = [
        [air, *(_cell(rows, scenario, air, network) for scenario, network in places)]
        for air in dict.fromkeys(row["weather"] for row in rows)
    ]
    return f"{table(headings, lines)}\n\n{_of_paper(rows)}"


def _cell(rows: Sequence[Row], scenario: str, air: str, network: str) -> str:
    """Return the error of a point, or how many of its runs complete."""
    found = {"scenario": scenario, "weather": air, "network": network}
    row = next(row for row in rows if row.items() >= found.items())
    if row["completed"] != row["flights"]:
        return f"{row['completed']} of {row['flights']} complete"
    return f"{100.0 * float(row['payload_rms_m']):.0f} cm"


def _of_paper(rows: Sequence[Row]) -> str:
    """Return how many runs of the paper's algorithm complete, on a perfect network and on others."""

    def completed(own: Sequence[Row]) -> str:
        done, runs = (sum(int(row[name]) for row in own) for name in ("completed", "flights"))
        return f"{done} of {runs}"

    own = [row for row in rows if row["scenario"] == PAPER]
    perfect = completed([row for row in own if row["network"] == PERFECT])
    others = completed([row for row in own if row["network"] != PERFECT])
    return (
        "The paper's algorithm with our weights (`paper`), whose agents are told the states, completes "
        f"{perfect} runs on the perfect network and {others} on the others."
    )


# Networks of the table on targets that one agent knows, with their headings.
_TOLD: Mapping[str, str] = {
    "perfect": "perfect network",
    "200 ms, 30 % loss": "200 ms, 30 % loss",
    "500 ms": "500 ms delay",
    "90 % loss": "90 % loss",
    "5 s, own sensors": "5 s of silence",
    "5 s, own sensors, gusts": "and gusts of 1 m/s",
}
_WORDS: Mapping[str, str] = {
    "eager": "followed at once (`eager`)",
    "confirmed": "once all have it (`confirmed`)",
    "stop": "at once, with a stop in silence",
    "confirmed, stop": "once all have it, with a stop",
}


def known(rows: Sequence[Row]) -> str:
    """Return the table of targets that one agent knows, a row for each rule."""
    lines = []
    for rule in (rule for rule in RULES if rule != ALL):
        lines.append([_WORDS[rule], *(_away(rows, rule, network) for network in _TOLD)])
    return table(["target told to agent 1", *_TOLD.values()], lines)


def _away(rows: Sequence[Row], rule: str, network: str) -> str:
    """Return the distance from the run in which all are told, or how many runs complete."""
    found = {"scenario": TEAM, "rule": rule, "network": network}
    row = next((row for row in rows if row.items() >= found.items()), None)
    if row is None:
        return "as without"
    if row["completed"] != row["flights"]:
        return f"{row['completed']} of {row['flights']} complete"
    return f"{100.0 * float(row['away_rms_m']):.0f} cm"
