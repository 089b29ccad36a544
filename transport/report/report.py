"""Report of a run folder: summary.json, steps.csv and figures from its log, and the printed table."""

import csv
import io
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import orjson
from rich.table import Table
from rich.text import Text

from protocol.scenario.setup import Setup
from transport.analysis.metrics import summarise
from transport.analysis.series import SWING_S, counted
from transport.analysis.steps import steps_columns, steps_rows
from transport.log.run_folder import RecordedRun, open_run

# Violations below this share of a constraint's range are within the solver's tolerance.
HELD = 1e-6

# Largest local error of the plant's integration with which trajectories are accurate.
ACCURATE = 1e-6

# Number of faults in the table, so that it fits a screen.
_SHOWN_FAULTS = 20

# Bodies with a distance from obstacles, as the report names them.
_CLEAR = {"uav": "UAVs", "rod": "rods", "payload": "payload"}
_COLOURS = {"completed": "green", "diverged": "red", "aborted": "red", "unknown": "yellow"}


def write_report(folder: Path, *, figures: bool = True, setup: Setup | None = None) -> dict[str, Any]:
    """Write or replace the report of a recorded run as `report_run` does, without forks; return the summary.

    The scenario is read from the folder unless the setup is given.

    Raises: LogError: there is no readable log; ScenarioError: the folder's scenario cannot be read.
    """
    return report_run(open_run(folder, horizons=False, setup=setup), figures=figures)


def report_run(run: RecordedRun, *, figures: bool = True, forks: bool = False, pdf: bool = False) -> dict[str, Any]:
    """Write or replace summary.json, steps.csv and the figures of a recorded run; return the summary.

    Figures take most of the time; with `forks` on two cores half of it.
    """
    folder, setup, log = run.folder, run.setup, counted(run.setup, run.log)
    summary = summarise(setup, log)
    write_whole(folder / "summary.json", orjson.dumps(summary, option=orjson.OPT_INDENT_2) + b"\n")
    write_csv(folder / "steps.csv", steps_rows(setup, log), steps_columns(setup))
    if figures:
        from transport.report.figures import draw  # loads matplotlib, 0.3 s that runs without figures save

        for old in [file for kind in ("png", "svg", "pdf") for file in (folder / "figures").glob(f"*.{kind}")]:
            old.unlink()  # figures of an older run
        draw(setup, log, folder / "figures", forks=forks, pdf=pdf)
    return summary


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return the table printed at the end of a run, from the result of `write_report`."""
    table = Table(box=None, show_header=False, title=_title(summary), title_justify="left")
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in _lines(summary):
        table.add_row(name, Text(text))
    for i, (time_s, text) in enumerate(_faults(summary)):
        entry = Table.grid(padding=(0, 2))  # a long text goes on below its beginning
        entry.add_column(no_wrap=True)
        entry.add_column()
        entry.add_row(time_s, Text(text))
        table.add_row("" if i else "faults", entry)
    if summary["log_cut"]:
        table.add_row("log", Text(summary["log_cut"]))
    return table


def warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return the reasons not to trust the numbers of a run, one line each, from the result of `write_report`."""
    error = summary["local_error_max"]
    if error is None or error <= ACCURATE:
        return []
    advice = "set a smaller plant.tolerance or plant.step_s"
    return [f"the plant's integration has a local error of {error:.1e}, above {ACCURATE:g}: {advice}"]


def _title(summary: Mapping[str, Any]) -> Text:
    outcome = summary["outcome"]
    reason = f": {summary['reason']}" if summary["reason"] else ""
    return Text.assemble((summary["scenario"], "bold"), " ", (f"{outcome}{reason}", f"bold {_COLOURS[outcome]}"))


def _clearances(clear_m: Mapping[str, float | None]) -> str:
    return ", ".join(f"{_text(clear_m[key], '.3f')} m {of}" for key, of in _CLEAR.items())


def _lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    cost, controller, solver = (summary[part] for part in ("cost", "controller", "solver"))
    uavs, payload = summary["uav_tracking"], summary["payload_tracking"]
    lines = [
        (
            "simulated",
            f"{summary['sim_time_s']:.2f} s in {_text(summary['wall_time_s'], '.2f')} s of wall time "
            f"({_text(summary['real_time_factor'], '.2f')} x real time)",
        ),
        (
            "controller",
            f"{controller['agents']} agent{'s' * (controller['agents'] != 1)} every "
            f"{1e3 * controller['sampling_period_s']:g} ms, "
            + (
                controller["name"]
                if controller["name"] != "mpc"
                else f"{controller['horizon']} steps, {controller['prediction'].replace('_', ' ')}, "
                f"relaxation {controller['relaxation']:g}"
            ),
        ),
        ("cost", f"mean {_text(cost['mean'], '.3g')}, max {_text(cost['max'], '.3g')}"),
        ("payload attitude", _text(summary["attitude_max_deg"], ".2f", "max {} deg")),
        *(
            (f"{name} error", f"rms {_text(of['rms_m'], '.3f')} m, max {_text(of['max_m'], '.3f')} m")
            for name, of in (("UAV", uavs), ("payload", payload))
        ),
        ("payload swing", _swing(payload)),
        *([("targets", _reached(summary["targets"]))] if summary.get("targets") else []),
        *([("cables", _slack(summary["cables"]))] if summary.get("cables") else []),
        *([("estimate", _estimate(summary["estimate"]))] if summary.get("estimate") else []),
        ("separation", _text(summary["separation_min_m"], ".3f", "min {} m")),
        *([("clearance", _clearances(clear))] if (clear := summary.get("clearance_min_m")) else []),
        ("limits", _constraints(summary["constraint_violation_max"])),
        ("integration", _text(summary["local_error_max"], ".1e", "largest local error {}")),
        ("agent step", _milliseconds(summary["agent_step_ms"])),
        ("rest of tick", _milliseconds(summary["rest_of_tick_ms"])),
        *([("deadlines", _deadlines(summary["deadline"]))] if summary["deadline"]["plans"] else []),
        ("plans", _plans(summary["messages"], summary["plan_age_ticks"])),
        ("solver", f"{solver['fallbacks']} fallbacks, {solver['failures']} failures"),
    ]
    if summary["rejections"]:
        lines.append(("rejected", _rejected(summary["messages"]["rejected"], summary["rejections"])))
    return lines


def _faults(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return time and text of the first faults; the reason of a failed run is in the title."""
    faults = [fault for fault in summary["faults"] if fault["what"] != summary["reason"]]
    shown = [(f"{fault['time_s']:6.2f} s", str(fault["what"])) for fault in faults[:_SHOWN_FAULTS]]
    more = len(faults) - _SHOWN_FAULTS
    return [*shown, (" " * 8, f"and {more} more in summary.json")] if more > 0 else shown


def _reached(targets: Sequence[Mapping[str, Any]]) -> str:
    errors_m = [target["error_m"] for target in targets if target["error_m"] is not None]
    largest = f", payload at most {max(errors_m):.3f} m away" if errors_m else ""
    return f"{len(errors_m)} of {len(targets)} reached{largest}"


def _swing(payload: Mapping[str, Any]) -> str:
    text = _text(payload["swing_m"], ".3f", f"max {{}} m in the last {SWING_S:g} s")
    return text if payload["decays"] is None else f"{text}, {'decays' if payload['decays'] else 'does not decay'}"


def _slack(cables: Mapping[str, Any]) -> str:
    times, left = cables["slack"], cables["slack_at_end"]
    text = _text(cables["tension_min_N"], ".2f", "min tension {} N")
    if not times:
        return f"{text}, never slack"
    end = f"{left} slack at the end" if left else "all taut again"
    return f"{text}, slack {times} time{'s' * (times > 1)}, at most {cables['slack_longest_s']:.2f} s, {end}"


def _estimate(estimate: Mapping[str, Any]) -> str:
    return (
        f"payload rms {estimate['position_rms_m']:.3f} m, {estimate['attitude_rms_deg']:.2f} deg; "
        f"NEES {estimate['nees']:.1f} of 6, NIS {_text(estimate['nis'], '.2f')} of 1"
    )


def _constraints(violation: float | None) -> str:
    if violation is None:
        return "-"
    return "held" if violation < HELD else f"exceeded by {100.0 * violation:.2g} % of their range"


def _plans(messages: Mapping[str, Any], ages: Mapping[str, Any]) -> str:
    if ages["mean"] is None and not messages["sent"]:
        return "-"
    shared, planned = messages["shared"], messages["planned"]
    unsent = f"{shared} of {planned} sent to the other agents ({shared / planned:.1%}); " if shared < planned else ""
    return (
        f"{unsent}{messages['lost']} of {messages['sent']} lost, {messages['late']} late; "
        f"age {_text(ages['mean'], '.2f')} ticks, max {_text(ages['max'], 'd')}"
    )


def _rejected(total: int, rejections: Sequence[Mapping[str, Any]]) -> str:
    """Return the total, and the sender of most rejected messages."""
    counts: Counter[str] = Counter()
    for entry in rejections:
        counts[entry["sender"]] += entry["count"]
    sender, most = counts.most_common(1)[0]
    worst = next(entry for entry in rejections if entry["sender"] == sender)
    return f"{total} messages, {most} from {sender} ({worst['reason'].replace('_', ' ')})"


def _deadlines(deadline: Mapping[str, Any]) -> str:
    share = _text(deadline["share"], ".2%", "{}")
    worst = ""
    if deadline["missed"]:
        worst_ms = deadline["worst_ms"]
        worst = ", no plan of which arrived" if worst_ms is None else f", worst plan {worst_ms:.1f} ms late"
    return f"{deadline['missed']} of {deadline['plans']} missed ({share}){worst}; ticks opened late: " + _milliseconds(
        deadline["tick_late_ms"]
    )


def _milliseconds(spread: Mapping[str, Any]) -> str:
    if spread["p50"] is None:
        return "-"
    return f"median {spread['p50']:.2f} ms, p99 {spread['p99']:.2f} ms, max {spread['max']:.1f} ms"


def _text(value: float | None, form: str, sentence: str = "{}") -> str:
    """Return a number in a sentence, or a dash for None."""
    return "-" if value is None else sentence.format(format(value, form))


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write a table atomically; floats are written by repr, which reads back as the same bits."""
    with atomic_file(path) as file, io.TextIOWrapper(file, encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_file(path) as file:
        file.write(content)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that gets its name only when it is complete."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        yield file
    os.replace(partial, path)
