"""Report of a run folder: summary.json, steps.csv and figures from its log, and the printed table."""

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import orjson
from rich.table import Table
from rich.text import Text

from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.metrics import summarise
from transport.analysis.series import SWING_S
from transport.analysis.steps import steps_columns, steps_rows
from transport.log.run_log import RecordedRun, open_run
from transport.protocol.scenario.setup import Setup

# Violations below this share of a constraint's range are within the solver's tolerance.
HELD = 1e-6
# Largest local error of the plant's integration with which trajectories are accurate.
ACCURATE = 1e-6
# Number of faults in the table, so that it fits a screen.
_SHOWN_FAULTS = 20
# Bodies with a distance from obstacles, as the report names them.
_CLEAR = {"uav": "UAVs", "rod": "rods", "payload": "payload"}
_COLOURS = {
    "completed": "green",
    "failed": "red",
    "diverged": "red",
    "aborted": "red",
    "unknown": "yellow",
}


def write_report(
    folder: Path, *, figures: bool = True, setup: Setup | None = None
) -> dict[str, Any]:
    """Write or replace the report of a recorded run as `report_run` does, without forks.

    Return the summary.

    The scenario is read from the folder unless the setup is given.

    Raises: LogError: there is no readable log; ScenarioError: the folder's scenario cannot be read.
    """
    return report_run(open_run(folder, horizons=False, setup=setup), figures=figures)


def report_run(
    run: RecordedRun, *, figures: bool = True, forks: bool = False, pdf: bool = False
) -> dict[str, Any]:
    """Write or replace summary.json, steps.csv and the figures of a recorded run.

    Return the summary.

    Figures take most of the time; with `forks` on two cores half of it.
    """
    folder = run.folder
    analysed = AnalysedRun.of(run.setup, counted(run.setup, run.log))
    summary = summarise(analysed)
    write_whole(folder / "summary.json", orjson.dumps(summary, option=orjson.OPT_INDENT_2) + b"\n")
    write_csv(folder / "steps.csv", steps_rows(analysed), steps_columns(analysed.setup))
    if figures:
        from transport.report.figures import (
            draw,  # loads matplotlib, 0.3 s that runs without figures save
        )

        for old in [
            file
            for kind in ("png", "svg", "pdf")
            for file in (folder / "figures").glob(f"*.{kind}")
        ]:
            old.unlink()  # figures of an older run
        draw(analysed, folder / "figures", forks=forks, pdf=pdf)
    return summary


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return the table printed at the end of a run, from the result of `write_report`."""
    outcome = summary["outcome"]
    reason = f": {summary['reason']}" if summary["reason"] else ""
    title = Text.assemble(
        (summary["scenario"], "bold"), " ", (f"{outcome}{reason}", f"bold {_COLOURS[outcome]}")
    )
    table = Table(box=None, show_header=False, title=title, title_justify="left")
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in _lines(summary):
        table.add_row(name, Text(text))
    # The reason of a failed run is in the title.
    faults = [fault for fault in summary["faults"] if fault["what"] != summary["reason"]]
    shown = [(f"{fault['time_s']:6.2f} s", str(fault["what"])) for fault in faults[:_SHOWN_FAULTS]]
    if len(faults) > _SHOWN_FAULTS:
        shown.append((" " * 8, f"and {len(faults) - _SHOWN_FAULTS} more in summary.json"))
    for i, (time_s, text) in enumerate(shown):
        table.add_row("" if i else "faults", Text(f"{time_s}  {text}"))
    if summary["log_cut"]:
        table.add_row("log", Text(summary["log_cut"]))
    return table


def warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return the reasons not to trust the numbers of a run, one line each, from the result of `write_report`."""
    error = summary["local_error_max"]
    if error is None or error <= ACCURATE:
        return []
    advice = "set a smaller plant.tolerance or plant.step_s"
    return [
        f"the plant's integration has a local error of {error:.1e}, above {ACCURATE:g}: {advice}"
    ]


def _lines(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield name and text of the rows of the table."""
    wall, factor = (
        _text(summary["wall_time_s"], "{:.2f} s"),
        _text(summary["real_time_factor"], "{:.2f}"),
    )
    yield (
        "simulated",
        f"{summary['sim_time_s']:.2f} s in {wall} of wall time ({factor} x real time)",
    )
    controller, cost, payload = summary["controller"], summary["cost"], summary["payload_tracking"]
    name = controller["name"]
    if name == "mpc":
        prediction = controller["prediction"].replace("_", " ")
        name = (
            f"{controller['horizon']} steps, {prediction}, relaxation {controller['relaxation']:g}"
        )
    agents = f"{controller['agents']} agent{'s' * (controller['agents'] != 1)}"
    yield "controller", f"{agents} every {1e3 * controller['sampling_period_s']:g} ms, {name}"
    yield "cost", f"mean {_text(cost['mean'], '{:.3g}')}, max {_text(cost['max'], '{:.3g}')}"
    yield "payload attitude", _text(summary["attitude_max_deg"], "max {:.2f} deg")
    for name, error in (("UAV", summary["uav_tracking"]), ("payload", payload)):
        yield (
            f"{name} error",
            f"rms {_text(error['rms_m'], '{:.3f} m')}, max {_text(error['max_m'], '{:.3f} m')}",
        )
    yield "payload swing", _text(payload["swing_m"], f"max {{:.3f}} m in the last {SWING_S:g} s")
    if targets := summary.get("targets"):
        errors_m = [target["error_m"] for target in targets if target["error_m"] is not None]
        largest = f", payload at most {max(errors_m):.3f} m away" if errors_m else ""
        yield "targets", f"{len(errors_m)} of {len(targets)} reached{largest}"
    if cables := summary.get("cables"):
        slack = "slack {slack} times, at most {slack_longest_s:.2f} s, {slack_at_end} slack at the end".format(
            **cables
        )
        tension = _text(cables["tension_min_N"], "min tension {:.2f} N")
        yield "cables", f"{tension}, {slack if cables['slack'] else 'never slack'}"
    if found := summary.get("estimate"):
        accuracy = (
            f"payload rms {found['position_rms_m']:.3f} m, {found['attitude_rms_deg']:.2f} deg"
        )
        yield (
            "estimate",
            f"{accuracy}; NEES {found['nees']:.1f} of 6, NIS {_text(found['nis'], '{:.2f}')} of 1",
        )
    yield "separation", _text(summary["separation_min_m"], "min {:.3f} m")
    if clear := summary.get("clearance_min_m"):
        yield (
            "clearance",
            ", ".join(f"{_text(clear[key], '{:.3f} m')} {of}" for key, of in _CLEAR.items()),
        )
    yield "limits", _limits(summary["constraint_violation_max"], summary["solver"])
    yield "integration", _text(summary["local_error_max"], "largest local error {:.1e}")
    yield "agent step", _milliseconds(summary["agent_step_ms"])
    yield "rest of tick", _milliseconds(summary["rest_of_tick_ms"])
    if (deadline := summary["deadline"])["plans"]:
        worst = _text(deadline["worst_ms"], "worst plan {:.1f} ms late", "no plan of which arrived")
        missed = f"{deadline['missed']} of {deadline['plans']} missed ({_text(deadline['share'], '{:.2%}')})"
        missed += f", {worst}" if deadline["missed"] else ""
        yield "deadlines", f"{missed}; ticks opened late: {_milliseconds(deadline['tick_late_ms'])}"
    yield "plans", _plans(summary["messages"], summary["plan_age_ticks"])
    if radio := summary.get("radio"):
        yield "radio", _radio(radio)
    yield "solver", _solver(summary["solver"])
    if summary["rejections"]:
        most = "{count} from {sender} to {by} ({reason})".format(**summary["rejections"][0])
        yield "rejected", f"{summary['messages']['rejected']} messages, {most}"


def _limits(violation: float | None, solver: Mapping[str, Any]) -> str:
    """Return whether the limits held: not if no controller saw to it, even if none was exceeded."""
    is_exceeded = violation is None or violation >= HELD
    exceeded = _text(violation, "exceeded by {:.2%} of their range")

    if solver["beyond_share"]:
        excess = exceeded if is_exceeded else "none exceeded"
        return f"{excess}, but {solver['failures']} steps without a controller"
    return exceeded if is_exceeded else "held"


def _solver(solver: Mapping[str, Any]) -> str:
    """Return fallbacks and failed steps in words, with every agent that failed."""
    counts = "{fallbacks} fallbacks, {failures} failures".format(**solver)
    agents = ["agent{agent} {failures} of {steps}".format(**one) for one in solver["failed_agents"]]
    return f"{counts}: {', '.join(agents)}" if agents else counts


def _plans(messages: Mapping[str, Any], ages: Mapping[str, Any]) -> str:
    if ages["mean"] is None and not messages["sent"]:
        return "-"
    shared, planned = messages["shared"], messages["planned"]
    unsent = (
        f"{shared} of {planned} sent to the other agents ({shared / planned:.1%}); "
        if shared < planned
        else ""
    )
    age = f"age {_text(ages['mean'], '{:.2f}')} ticks, max {_text(ages['max'], '{:d}')}"
    in_transit = messages.get("in_transit", 0)  # summaries of earlier versions lack it
    unarrived = f"{in_transit} not arrived at the end, " if in_transit else ""
    lost = f"{messages['lost']} of {messages['sent']} lost"
    return f"{unsent}{lost}, {unarrived}{messages['late']} late; {age}"


def _radio(radio: Mapping[str, Any]) -> str:
    """Return airtime, deliveries, delays and losses of the team's radio in one line."""
    parts = [
        f"{radio['rate_mbps']:g} Mb/s, {_text(radio['airtime_share'], '{:.1%}')} of the airtime",
        f"{_text(radio['delivered_share'], '{:.1%}')} delivered",
    ]
    delays = radio["delay_ms"]
    if delays["p50"] is not None:
        parts.append("delay median {p50:.1f} ms, p99 {p99:.1f} ms".format(**delays))
    losses = {
        "collisions": "lost by collisions",
        "weak": "too weak",
        "queue_drops": "dropped by queues",
        "given_up": "given up",
        "repetitions": "repetitions",
    }
    parts += [f"{radio[key]} {words}" for key, words in losses.items() if radio[key]]
    return "; ".join(parts)


def _milliseconds(spread: Mapping[str, Any]) -> str:
    return (
        "-"
        if spread["p50"] is None
        else "median {p50:.2f} ms, p99 {p99:.2f} ms, max {max:.1f} ms".format(**spread)
    )


def _text(value: float | None, sentence: str, otherwise: str = "-") -> str:
    return otherwise if value is None else sentence.format(value)


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
