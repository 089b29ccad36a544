"""HTML of the panel: notice, tables of payload and agents, events and legend."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from transport.model.arrays import Array
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.scene.lines_meshes_and_labels import Colour
from transport.scene.scene_at_tick import Air, Scene
from transport.scene.uav_and_link_colours import DARK, age_colour, uav_colour

_TABLE = "font-size:12px;border-collapse:collapse;font-variant-numeric:tabular-nums;margin:4px 8px"
_CELL = "padding:1px 4px;white-space:nowrap"
_ALARM: Colour = (178, 24, 43)
# Ages in the legend, s.
_AGES = ((0.0, "fresh"), (0.2, "0.2 s"), (0.5, "0.5 s"))
# Delay of a shown active run from which it is coloured, s.
_BEHIND_S = 1.0
# Links that are named.
_SHOWN_LINKS = 8


def notice(text: str, *, warning: bool) -> str:
    """Return a sentence in a box; nothing for an empty one."""
    colours = "#fff3cd;border:1px solid #d9a400" if warning else "#eef3f8;border:1px solid #b9c9da"
    box = "color:#222;border-radius:4px;padding:6px 8px;margin:4px 12px;font-size:12px"
    return f'<div style="background:{colours};{box}">{escape(text)}</div>' if text else ""


def flight(scene: Scene, duration_s: float, behind_s: float | None = None) -> str:
    """Return a table of time, phase, cost, attitude and position error of the payload.

    With `behind_s` it says how long ago this was in an active run, s.
    """
    roll, pitch, yaw = scene.attitude_deg
    behind = []
    if behind_s is not None:
        text = f"{behind_s:.1f} s ago"
        behind = [("shown", text if behind_s < _BEHIND_S else _coloured(text, _ALARM))]
    rows = [] if scene.air is None else [("radio", _air(scene.air))]
    return _table(
        [
            ("time", f"{scene.time_s:.2f} of {duration_s:.1f} s, {escape(scene.phase)}"),
            *behind,
            ("stage cost", f"{scene.cost:.5f}"),
            ("payload", f"roll {roll:+.2f}, pitch {pitch:+.2f}, yaw {yaw:+.2f} deg"),
            ("payload error", f"{scene.error_m:.3f} m"),
            ("fail-safe", ", ".join(f"UAV{uav}" for uav in scene.fail_safe) or "-"),
            *rows,
        ]
    )


def _air(air: Air) -> str:
    delivered = "-" if air.delivered_share is None else f"{air.delivered_share:.0%} delivered"
    return f"{air.airtime_share:.0%} of the airtime, {delivered} in the last second"


def target(target_I: Array, arrives_s: float, scene: Scene) -> str:
    """Return a sentence about the target of the payload in a scene.

    Args:
        target_I: Position of the target, (3,), inertial frame, m.
        arrives_s: Time at which the reference arrives there, s.
        scene: Scene with the present position of the payload.
    """
    x, y, z = target_I.tolist()
    distance_m = float(np.linalg.norm(scene.payload_I - target_I))
    when = f"since t = {arrives_s:.1f} s"
    if arrives_s > scene.time_s:
        when = f"arrives at t = {arrives_s:.1f} s"
    place = f"x {x:g}, y {y:g}, down {z:g} m"
    return _small(f"target {place}: {when}; {distance_m:.2f} m away")


def agents(scene: Scene, owned: Sequence[Sequence[int]], period_s: float) -> str:
    """Return a table with a row per agent.

    Step time, ages of the measurement and of each plan it used.
    """
    numbers = range(1, len(owned) + 1)
    rows = [["agent", "step", "measured", *(f"from {peer}" for peer in numbers)]]
    for agent, uavs, report in zip(numbers, owned, scene.reports, strict=True):
        name = f"{_coloured('&#9632;', uav_colour(uavs[0]))} {agent}"
        if report is None or agent not in scene.members:
            rows.append([name, _coloured("none" if agent in scene.members else "off", _ALARM)])
            continue
        solved = report.status == "solved"
        step = f"{report.times_ms[-1]:.1f}" if solved else _coloured(escape(report.status), _ALARM)
        ages = dict(zip(report.peers, report.plan_ages, strict=True))
        used = (_age(ages.get(peer, -1), period_s, usual=1) for peer in numbers)
        rows.append([name, step, _age(report.measurement_age, period_s, usual=0), *used])
    units = _small(
        "step time in ms; age of the measurement and of each plan used, in s; "
        "off: not on the roster"
    )
    return f'<div style="overflow-x:auto">{_table(rows)}</div>{units}'


def links(in_force: Mapping[tuple[int, int], LinkSection]) -> str:
    """Return how many links between agents are impaired, and which are cut."""
    cut = [ends for ends, section in in_force.items() if section.loss >= 1.0]
    impaired = [ends for ends, section in in_force.items() if not section.perfect]
    names = ", ".join(f"{sender} to {receiver}" for sender, receiver in cut[:_SHOWN_LINKS])
    more = ", ..." if len(cut) > _SHOWN_LINKS else ""
    text = f"{len(impaired)} of {len(in_force)} links impaired"
    return _small(f"{text}; cut: {names}{more}" if cut else text)


def legend() -> str:
    """Return the meaning of colours, lines and grid."""
    colours = [*((age_colour(age, 0.0), text) for age, text in _AGES), (DARK, "over 1 s or none")]
    ages = " ".join(f"{_coloured('&#9644;', colour)} {text}" for colour, text in colours)
    return _small(
        f"age of the plan in use:<br>{ages}<br>"
        "the half of a link next to a UAV shows the plans it receives<br>"
        "coloured lines: paths that each agent predicts for its UAVs and the payload; "
        "arrows: thrust<br>"
        "grey UAV: its agent is off the roster<br>"
        "grid squares of 1 m; axes below the start: x red, y green, z (down) blue"
    )


def _age(ticks: int, period_s: float, usual: int) -> str:
    """Return an age in s, coloured if it is more than the usual one over a perfect network."""
    if ticks < 0:
        return "-"
    text = f"{ticks * period_s:.2f}"
    return (
        text
        if ticks <= usual
        else _coloured(f"<b>{text}</b>", age_colour(ticks * period_s, period_s))
    )


def _table(rows: Iterable[Iterable[str]]) -> str:
    cells = ("".join(f'<td style="{_CELL}">{cell}</td>' for cell in row) for row in rows)
    return f'<table style="{_TABLE}">{"".join(f"<tr>{row}</tr>" for row in cells)}</table>'


def _small(text: str) -> str:
    return f'<div style="font-size:12px;margin:2px 12px">{text}</div>'


def _coloured(text: str, colour: Colour) -> str:
    return f'<span style="color:rgb{colour}">{text}</span>'
