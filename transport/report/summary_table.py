"""Table of a summary that is printed at the end of a run, and reasons not to trust its numbers."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich.table import Table
from rich.text import Text

from transport.analysis.cost_and_tracking_metrics import SWING_S
from transport.report.summary_texts import (
    deadlines_text,
    limits_text,
    milliseconds,
    number_text,
    own_constraint_text,
    plans_text,
    radio_text,
    separation_text,
    solver_text,
)

# Largest local error of the plant's integration with which trajectories are accurate.
ACCURATE = 1e-6
# Number of faults in the table, so that it fits a screen.
_SHOWN_FAULTS = 20
# Mean NEES from which a filter is said to be inconsistent, as a multiple of that of a consistent one.
_INCONSISTENT = 10.0
# Degrees of freedom of a pose, the mean NEES of a consistent filter.
_POSE_AXES = 6
_MS_PER_S = 1e3
# Bodies with a distance from obstacles, as the table names them.
_CLEAR = {"uav": "UAVs", "rod": "rods", "payload": "payload"}
_COLOURS = {
    "completed": "green",
    "failed": "red",
    "diverged": "red",
    "collided": "red",
    "aborted": "red",
    "unknown": "yellow",
}

_Row = tuple[str, str]
_Summary = Mapping[str, Any]


def summary_table(summary: _Summary) -> Table:
    """Return the table printed at the end of a run, from the result of `write_report`."""
    table = Table(box=None, show_header=False, title=_title(summary), title_justify="left")
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, text in _rows(summary):
        table.add_row(name, Text(text))

    for i, text in enumerate(_faults(summary)):
        table.add_row("" if i else "faults", Text(text))
    if summary["log_cut"]:
        table.add_row("log", Text(summary["log_cut"]))
    return table


def warnings(summary: _Summary) -> list[str]:
    """Return the reasons not to trust the numbers of a run, one line each.

    The summary is the result of `write_report`.
    """
    error = summary["local_error_max"]
    if error is None or error <= ACCURATE:
        return []
    size = f"the plant's integration has a local error of {error:.1e}, above {ACCURATE:g}"
    return [f"{size}: set a smaller plant.tolerance or plant.step_s"]


def _title(summary: _Summary) -> Text:
    """Return scenario, outcome and reason."""
    outcome = summary["outcome"]
    reason = f": {summary['reason']}" if summary["reason"] else ""
    coloured = f"{outcome}{reason}", f"bold {_COLOURS[outcome]}"
    return Text.assemble((summary["scenario"], "bold"), " ", coloured)


def _faults(summary: _Summary) -> list[str]:
    """Return a line for each fault, up to a number."""
    # The reason of a failed run is in the title.
    faults = [fault for fault in summary["faults"] if fault["what"] != summary["reason"]]
    lines = [f"{fault['time_s']:6.2f} s  {fault['what']}" for fault in faults[:_SHOWN_FAULTS]]
    if len(faults) > _SHOWN_FAULTS:
        lines.append(f"{'':8}  and {len(faults) - _SHOWN_FAULTS} more in summary.json")
    return lines


def _rows(summary: _Summary) -> Iterator[_Row]:
    """Yield name and text of the rows of the table."""
    yield from _run_rows(summary)
    yield from _flight_rows(summary)
    yield from _constraint_rows(summary)
    yield from _time_rows(summary)
    yield from _message_rows(summary)


def _run_rows(summary: _Summary) -> Iterator[_Row]:
    """Yield the rows about the run and its controller."""
    wall = number_text(summary["wall_time_s"], "{:.2f} s")
    factor = number_text(summary["real_time_factor"], "{:.2f}")
    simulated_s = summary["sim_time_s"]
    yield "simulated", f"{simulated_s:.2f} s in {wall} of wall time ({factor} x real time)"

    controller = summary["controller"]
    name = controller["name"]
    if name == "mpc":
        horizon = f"{controller['horizon']} steps"
        prediction = controller["prediction"].replace("_", " ")
        name = f"{horizon}, {prediction}, relaxation {controller['relaxation']:g}"
    agents = f"{controller['agents']} agent{'s' * (controller['agents'] != 1)}"
    period_ms = _MS_PER_S * controller["sampling_period_s"]
    yield "controller", f"{agents} every {period_ms:g} ms, {name}"


def _flight_rows(summary: _Summary) -> Iterator[_Row]:
    """Yield the rows about cost, attitude, tracking, targets, cables and estimates."""
    cost = summary["cost"]
    mean = number_text(cost["mean"], "{:.3g}")
    highest = number_text(cost["max"], "{:.3g}")
    yield "cost", f"mean {mean}, max {highest}"
    yield "payload attitude", number_text(summary["attitude_max_deg"], "max {:.2f} deg")

    payload = summary["payload_tracking"]
    yield "UAV error", _tracking(summary["uav_tracking"])
    yield "payload error", _tracking(payload)
    swing = f"max {{:.3f}} m in the last {SWING_S:g} s"
    yield "payload swing", number_text(payload["swing_m"], swing)

    # Summaries of earlier versions lack some keys.
    if summary.get("targets"):
        yield "targets", _targets(summary["targets"])
    if summary.get("cables"):
        yield "cables", _cables(summary["cables"])
    if summary.get("estimate"):
        yield "estimate", _estimate(summary["estimate"])


def _tracking(error: Mapping[str, Any]) -> str:
    """Return RMS and maximum of a position error."""
    rms = number_text(error["rms_m"], "{:.3f} m")
    largest = number_text(error["max_m"], "{:.3f} m")
    return f"rms {rms}, max {largest}"


def _targets(targets: list[Mapping[str, Any]]) -> str:
    """Return how many targets were reached, and how closely."""
    errors_m = [target["error_m"] for target in targets if target["error_m"] is not None]
    largest = f", payload at most {max(errors_m):.3f} m away" if errors_m else ""
    return f"{len(errors_m)} of {len(targets)} reached{largest}"


def _cables(cables: Mapping[str, Any]) -> str:
    """Return the least tension of the cables, and how often and how long they were slack."""
    tension = number_text(cables["tension_min_N"], "min tension {:.2f} N")
    if not cables["slack"]:
        return f"{tension}, never slack"
    slack = "slack {slack} times, at most {slack_longest_s:.2f} s".format(**cables)
    return f"{tension}, {slack}, {cables['slack_at_end']} slack at the end"


def _estimate(estimate: Mapping[str, Any]) -> str:
    """Return errors of the estimates and how they match their covariance."""
    accuracy = "payload rms {position_rms_m:.3f} m, {attitude_rms_deg:.2f} deg".format(**estimate)
    nis = number_text(estimate["nis"], "{:.2f}")
    consistency = f"NEES {estimate['nees']:.1f} of {_POSE_AXES}, NIS {nis} of 1"
    if estimate["nees"] > _INCONSISTENT * _POSE_AXES:
        consistency += (
            ": far more wrong than it says; forces of wind or mass, if any, are estimated with "
        )
        consistency += "controller.disturbance.estimate=true"
    return f"{accuracy}; {consistency}"


def _constraint_rows(summary: _Summary) -> Iterator[_Row]:
    """Yield the rows about distances, limits and the accuracy of the plant."""
    yield "separation", separation_text(summary)
    clear_m = summary.get("clearance_min_m")
    if clear_m:
        texts = [f"{number_text(clear_m[key], '{:.3f} m')} {body}" for key, body in _CLEAR.items()]
        yield "clearance", ", ".join(texts)
    yield "limits", limits_text(summary)
    for own in summary.get("own_constraints", ()):
        yield "own constraint", own_constraint_text(own)
    yield "integration", number_text(summary["local_error_max"], "largest local error {:.1e}")


def _time_rows(summary: _Summary) -> Iterator[_Row]:
    """Yield the rows about wall-clock times."""
    yield "agent step", milliseconds(summary["agent_step_ms"])
    yield "rest of tick", milliseconds(summary["rest_of_tick_ms"])
    if summary["deadline"]["plans"]:
        yield "deadlines", deadlines_text(summary["deadline"])


def _message_rows(summary: _Summary) -> Iterator[_Row]:
    """Yield the rows about plans, radio, solver and rejected messages."""
    yield "plans", plans_text(summary["messages"], summary["plan_age_ticks"])
    radio = summary.get("radio")
    if radio:
        yield "radio", radio_text(radio)
    yield "solver", solver_text(summary["solver"])
    if summary["rejections"]:
        most = "{count} from {sender} to {by} ({reason})".format(**summary["rejections"][0])
        yield "rejected", f"{summary['messages']['rejected']} messages, {most}"
