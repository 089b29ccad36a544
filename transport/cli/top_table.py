"""The table of `transport top`: a line for the run and one for each agent."""

from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from transport.monitor.watch import Watch

# The table mentions silence that lasts longer.
_QUIET_S = 2.0

_COLOURS = {"active": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red", "-": ""}
_LEFT = ("UAVs", "state", "plan ages", "QPs")


def table_of(watch: Watch, run: str, quiet_s: float = 0.0) -> Group:
    """Return the table of a run by name, with the time since the last message, s, if it is long."""
    content = watch.content()
    outcome, period_s = content["outcome"], watch.setup.settings.sampling_period_s
    ticks = content["ticks"]
    reason = f": {content['reason']}" if content["reason"] else ""
    ended = "" if outcome is None else f"  {outcome}{reason}"
    silence = f"  no message for {quiet_s:.0f} s" if quiet_s > _QUIET_S and outcome is None else ""
    lines: list[Text | Table] = [
        Text.assemble(
            (run, "bold"), (ended, "bold green" if outcome == "completed" else "bold red"), (silence, "yellow")
        ),
        Text(
            f"tick {content['tick']} of {ticks}, {content['time_s']:.2f} of {ticks * period_s:.2f} s  "
            f"{_number(content['real_time_factor'], '.2f')}x  cost {_number(content['cost'], '.5f')}  "
            f"attitude {_number(content['attitude_deg'], '.2f')} deg"
        ),
    ]
    rows = [_row(watch, agent) for agent in content["agents"]]
    # Empty columns are left out: terminals are narrow.
    names = [name for name in rows[0] if any(row[name] is not None for row in rows)]
    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in names:
        table.add_column(name, justify="left" if name in _LEFT else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row[name] or "" for name in names))
    lines.append(table)
    lines += [Text(f" {notice}", "yellow") for notice in content["notices"]]
    others = {name: count for name, count in content["rejections"].items() if not name.startswith("agent")}
    if others:
        lines.append(Text(" refused by " + ", ".join(f"{name}: {count}" for name, count in others.items())))
    return Group(*lines)


def _row(watch: Watch, agent: dict[str, Any]) -> dict[str, Text | str | None]:
    """Return the cells of an agent by column; None leaves the column out unless another agent needs it."""
    clock, ages, slack = watch.setup.scenario.clock, agent["plan_ages"], agent["slack_ms"]
    troubled = agent["fallbacks"] or agent["failures"]
    slack_cell = Text(_number(slack, ".1f"), "red" if slack is not None and slack < 0.0 else "")
    return {
        "agent": str(agent["agent"]),
        "UAVs": None if agent["uavs"] == [agent["agent"]] else " ".join(map(str, agent["uavs"])),
        "state": Text(agent["state"], _COLOURS[agent["state"]]),
        "tick": _number(agent["tick"], "d"),
        "step ms": _number(agent["step_ms"], ".2f"),
        "worst": _number(agent["worst_step_ms"], ".1f"),
        "slack": None if clock.speed == 0.0 else slack_cell,
        "plan ages": "-" if ages is None else " ".join("-" if age < 0 else str(age) for age in ages.values()),
        "lost": str(agent["lost"]),
        "late": str(agent["late"]),
        "missed": str(agent["missed"]) if clock.mode == "realtime" else None,
        "QPs": f"{agent['fallbacks']} fell back, {agent['failures']} failed" if troubled else None,
        "refused": str(agent["rejected"]) if agent["rejected"] else None,
        "off": str(agent["off_the_roster"]) if agent["off_the_roster"] else None,
    }


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
