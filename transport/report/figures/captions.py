"""Captions of the figures of a run for a paper: what is shown, with the numbers of its summary."""

from collections.abc import Mapping, Sequence
from typing import Any

from transport.protocol.scenario.setup.run_setup import Setup

Summary = Mapping[str, Any]  # docs/reference/summary.md


def captions(setup: Setup, summary: Summary, names: Sequence[str]) -> dict[str, str]:
    """Return the caption of each named figure of a run."""
    shown = {
        "performance": _performance(summary),
        "inputs": _inputs(summary),
        "trajectories": (
            f"Paths of the payload and of {setup.system.N} UAVs in space, with the team at the ends of "
            "phases. Dashed: reference."
        ),
        "timing": _timing(summary),
        "estimate": (
            "Error and attitude of the payload, and their estimate by the first agent with three "
            "standard deviations."
        ),
        "delays": "Delay of the plans that were used.",
        "radio": _radio(summary),
    }
    run = _run(setup, summary)
    return {name: f"{shown[name]} {run}" for name in names}


def text_of(made: Mapping[str, str]) -> str:
    """Return captions as Markdown, a heading for each figure."""
    return "\n".join(f"## {name}\n\n{caption}\n" for name, caption in made.items())


def _run(setup: Setup, summary: Summary) -> str:
    """Return scenario, team, network, end and version of a run."""
    count = summary["controller"]["agents"]
    agents = f"{count} agent{'s' * (count > 1)}"
    period_ms = 1e3 * setup.settings.sampling_period_s
    team = f"{setup.system.N} UAVs with {agents} every {period_ms:g} ms"
    end = f"{summary['outcome']} at {summary['sim_time_s']:.2f} s, seed {summary['seed']}"
    version = summary["versions"].get("payload-transport", "of unknown version")
    scenario = f"Scenario {summary['scenario']}: {team}, {_network(setup, summary)}"
    return f"{scenario}; {end}; payload-transport {version}."


def _network(setup: Setup, summary: Summary) -> str:
    """Return the links of the scenario in words, and how many plans were lost."""
    links = setup.scenario.links
    words = []
    if links.delay_s:
        words.append(f"{1e3 * links.delay_s:g} ms delay")
    if links.loss:
        words.append(f"{1e2 * links.loss:g} % packet loss")
    if summary["radio"]:
        words.append("a shared radio")
    lost, sent = summary["messages"]["lost"], summary["messages"]["sent"]
    return f"{', '.join(words) or 'links without delay and loss'} ({lost} of {sent} plans lost)"


def _performance(summary: Summary) -> str:
    uavs, payload = summary["uav_tracking"], summary["payload_tracking"]
    attitude = _number(summary["attitude_max_deg"], "{:.2f} degrees")
    return (
        "Distance of each UAV from its reference, error and attitude of the payload, and cost of the "
        f"team over time. UAVs: {_cm(uavs['rms_m'])} rms, at most {_cm(uavs['max_m'])}; payload: "
        f"{_cm(payload['rms_m'])} rms, at most {_cm(payload['max_m'])}, attitude at most {attitude}; "
        f"mean cost {_number(summary['cost']['mean'], '{:.3g}')}. Shaded: every other phase."
    )


def _inputs(summary: Summary) -> str:
    apart = _number(summary["separation_min_m"], "{:.3f} m")
    return (
        "Commanded thrust and moments or body rates of each UAV, and the smallest distance between two "
        f"UAVs, at least {apart}, over time. Dashed: limits. Shaded: every other phase."
    )


def _timing(summary: Summary) -> str:
    step = summary["agent_step_ms"] or {}
    median, high = (_number(step.get(name), "{:.2f} ms") for name in ("p50", "p99"))
    return (
        "Wall-clock time of each step of the agents and of the rest of each tick, and medians of its "
        f"stages. Step: median {median}, 99th percentile {high}."
    )


def _radio(summary: Summary) -> str:
    share = (summary["radio"] or {}).get("airtime_share")
    airtime = _number(None if share is None else 1e2 * share, "{:.1f} %")
    return f"Airtime of the shared radio, {airtime} in the mean, and what it delivers over time."


def _cm(value_m: float | None) -> str:
    return _number(None if value_m is None else 1e2 * value_m, "{:.1f} cm")


def _number(value: float | None, form: str) -> str:
    """Return a number with its unit; a run may end before it has one."""
    return "unknown" if value is None else form.format(value)
