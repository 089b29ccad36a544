"""Tables of the README that are made from results of others, and the short one of the weather."""

from collections.abc import Mapping, Sequence

from measured_results import AGILE, RESULTS
from table_rows_and_cells import interval, values
from tables import completed_of, table

from transport.experiments.information_experiment import ALL, RULES
from transport.experiments.simulation import Result
from transport.experiments.statistics import columns_of, with_spread
from transport.experiments.weather_experiment import NETWORKS, NONE, PERFECT

Row = Mapping[str, str]  # of points.csv
TEAM, ALONE = "precise", "alone"


def worth(rows: Sequence[Row]) -> str:
    """Return the table of payload errors in weather, a row for each weather."""
    headings = [
        "payload error, cm rms",
        *(f"{network} network" if network == PERFECT else network for network in NETWORKS),
        "`alone`, no network",
    ]
    places = [*((TEAM, network) for network in NETWORKS), (ALONE, NONE)]
    lines = [
        [air, *(_cell(rows, "payload_rms_m", scenario=scenario, weather=air, network=network)
                for scenario, network in places)]
        for air in dict.fromkeys(row["weather"] for row in rows)
    ]  # fmt: skip
    return table(headings, lines)


def _cell(rows: Sequence[Row], number: str, **labels: str) -> str:
    """Return mean and interval of a number of a point, cm, or how many of its runs complete.

    Empty for a point that is not flown.
    """
    row = next((row for row in rows if row.items() >= labels.items()), None)
    if row is None:
        return ""
    done, runs = int(row["completed"]), int(row["flights"])
    if done < runs:
        return f"{completed_of(done, runs)} complete"
    names = zip(("mean", "half_width", "low", "high"), columns_of(number, None), strict=True)
    values = {field: float(row[name]) if row[name] else None for field, name in names}
    return with_spread({**values, "n": done}, lambda value_m: f"{100.0 * value_m:.1f}")


# Networks of the table on targets that one agent knows, with their headings.
_TOLD: Mapping[str, str] = {
    "perfect": "perfect network, n = 1",
    "200 ms, 30 % loss": "200 ms, 30 % loss, n = 10",
    "90 % loss": "90 % loss, n = 10",
    "5 s, own sensors": "5 s of silence, own sensors, n = 10",
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
        places = ({"scenario": TEAM, "rule": rule, "network": network} for network in _TOLD)
        unchanged = "as `confirmed`" if rule.startswith("confirmed") else "as `eager`"
        cells = [_cell(rows, "away_rms_m", **place) or unchanged for place in places]
        lines.append([_WORDS[rule], *cells])
    return table(
        ["payload away from the run in which all are told, cm rms", *_TOLD.values()], lines
    )


# Cases of the table on drag, with their texts.
_DRAG: Mapping[str, str] = {
    "200 ms delay, 30 % loss": "known",
    "unknown drag, estimated, late": "not known, estimated",
    "1.5 times the known drag, late": "1.5 times the known, not estimated",
    "unknown drag, late": "not known, not estimated",
}


def drag(results: Sequence[Result]) -> str:
    """Return the table of fast flight with drag, from the results of the table `fast`."""
    fast = next(one for one in RESULTS if one.name == "fast")
    seeds = [run.seeds for row in fast.rows.values() for run in row if run is not None]
    flown = {}
    taken = 0
    for case, count in zip(AGILE, seeds, strict=True):
        flown[case] = results[taken : taken + count]
        taken += count

    mean = interval("payload_rms_m", 2, 100.0)
    lines = []
    for case, text in _DRAG.items():
        errors_m = values("payload_rms_m", flown[case])
        if len(errors_m) < len(flown[case]):
            text = f"{text}: {completed_of(len(errors_m), len(flown[case]))} complete"
        lines.append([text, mean(flown[case]), f"{100.0 * max(errors_m):.2f}"])
    return table(["drag", "payload error, cm rms", "worst run"], lines)
