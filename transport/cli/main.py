"""Command `transport`: the tables of its commands, and its answer without one."""

from functools import cache
from typing import Any

import typer
from typer import Option

from transport.cli.lazy import lazy_group

_EXPERIMENTS = {
    "latency": ("commands.experiment:COMMANDS", "Effect of a fixed delay on every link."),
    "loss": ("commands.experiment:COMMANDS", "Effect of packet loss, independent or in bursts."),
    "jitter": ("commands.experiment:COMMANDS", "Effect of the distribution of random delays."),
    "kill": ("commands.experiment:COMMANDS", "Effect of the death of each agent."),
    "deaths": ("commands.experiment:COMMANDS", "Effect of a permanent kill of a random agent."),
    "matrix": ("commands.experiment:COMMANDS", "Maps of cost and completion over delay and loss."),
    "ablation": ("commands.experiment:COMMANDS", "Contribution of each part of the algorithm."),
    "horizon": ("commands.experiment:COMMANDS", "Effect of horizon and terminal weight."),
    "hover": ("commands.experiment:COMMANDS", "Stability in a long hover after the maneuver."),
    "sharing": ("commands.experiment:COMMANDS", "Cost against the number of plans sent."),
    "radio": (
        "commands.experiment:COMMANDS",
        "Effect of the radio channel that the team itself fills.",
    ),
    "agile": ("commands.experiment:COMMANDS", "Fast flight: the payload's error over speed."),
    "weather": ("commands.experiment:COMMANDS", "Worth of the network in weather."),
    "information": ("commands.experiment:COMMANDS", "Targets that one agent knows."),
    "follow": ("commands.experiment:COMMANDS", "Error over the age of information."),
    "paper": ("commands.experiment:paper", "The paper's claim: centralized against distributed."),
    "scaling": ("commands.experiment:COMMANDS", "Growth of cost, computation and messages."),
}
_SCENARIO = {"new": ("commands.scenario:new", "Write a scenario for a team of any size.")}
_LOG = {
    "info": ("commands.log:info", "Describe the content of a log, and its gaps."),
    "export": ("commands.log:export", "Write a log as tables, or as a bag for ROS 2 and Foxglove."),
}
_LINK = {
    "set": ("commands.link:set_links", "Impair or repair links from the next tick on."),
    "clear": (
        "commands.link:clear_links",
        "Remove all impairments, also from the plant's links.",
    ),
}
_DEPLOY = {
    "keys": ("hosts.deploy:keys", "Create a certificate authority and process certificates."),
    "render": ("hosts.deploy:render", "Write one deployment folder per host."),
}
app = lazy_group(
    {
        "Simulate": {
            "run": (
                "commands.run:run",
                "Run a scenario with all its processes; record and report it.",
            ),
            "experiment": lazy_group(
                {"Commands": _EXPERIMENTS},
                help="Simulate many variations of a scenario and compare them.\n\n"
                "Prints a table and confidence intervals; writes tables and a figure.",
                epilog="Exit codes: 0 done, whatever the result; 2 usage, 3 scenario, "
                "4 cluster or worker lost, 7 some simulations raised an error, 130 interrupted.",
            ),
            "arena": (
                "commands.arena:arena",
                "Compare algorithms, yours too, on tasks and networks.",
            ),
            "worst": ("commands.worst:worst", "Search for the network that brings the team down."),
            "scenario": lazy_group(
                {"Commands": _SCENARIO},
                help="Create scenarios.",
            ),
            "validate": (
                "commands.scenario:validate",
                "Check a scenario and print it with every default.",
            ),
            "margins": (
                "commands.scenario:margins",
                "Compute how much model error a hover tolerates.",
            ),
            "doctor": ("commands.scenario:doctor", "Check that this machine can run a scenario."),
        },
        "Look at runs": {
            "view": ("commands.view:view", "Show a recorded or active run in the browser."),
            "plot": ("commands.plot:plot", "Regenerate metrics and figures of a recorded run."),
            "compare": (
                "commands.compare:compare",
                "Compare recorded runs in a table and in figures.",
            ),
            "log": lazy_group(
                {"Commands": _LOG},
                help="Describe and export the log of a run.",
                epilog="Exit codes: 0 done, also for an incomplete log; 2 the log cannot be read.",
            ),
            "replay": (
                "commands.replay:replay",
                "Feed a recorded run to one agent and compare its plans.",
            ),
        },
        "Act on an active run": {
            "top": ("commands.top:top", "Watch the agents of an active run."),
            "status": (
                "commands.status_target_and_fault:status",
                "Show the progress of a run, or the health of one process.",
            ),
            "target": (
                "commands.status_target_and_fault:target",
                "Send the payload of an active run to a target.",
            ),
            "land": (
                "commands.status_target_and_fault:land",
                "Let the team of an active run come down, and rest.",
            ),
            "abort": (
                "commands.status_target_and_fault:abort",
                "Let a team of vehicles come down at once, as fast as it can.",
            ),
            "release": (
                "commands.status_target_and_fault:release",
                "End a run whose UAVs have landed and are off their rods.",
            ),
            "link": lazy_group(
                {"Commands": _LINK},
                help="Change the links of an active run.",
            ),
            "fault": (
                "commands.status_target_and_fault:fault",
                "Kill, stop, continue or restart a process of an active run.",
            ),
        },
        "Start processes by hand": {
            "coordinator": (
                "hosts.processes:coordinator",
                "Run the coordinator: sampling clock and roster.",
            ),
            "plant": ("hosts.processes:plant", "Run the plant: dynamics and actuators."),
            "agent": (
                "hosts.processes:agent",
                "Run one agent: the controller of the UAVs it owns.",
            ),
            "vehicle": (
                "hosts.processes:vehicle",
                "Connect one UAV: its agent and its autopilot.",
            ),
            "record": (
                "hosts.processes:record",
                "Record and report a run whose processes were started by hand.",
            ),
        },
        "Connect hosts": {
            "deploy": lazy_group(
                {"Commands": _DEPLOY},
                help="Deploy a run to several hosts.",
            ),
            "router": (
                "hosts.processes:router",
                "Route messages between hosts without a direct connection.",
            ),
            "metrics": (
                "hosts.prometheus_metrics:metrics",
                "Export process metrics to Prometheus.",
            ),
            "ros2": ("commands.ros2:ros2", "Publish an active run for ROS 2 over rmw_zenoh."),
        },
    },
    name="transport",
    add_completion=True,
    help="Several UAVs carry one payload; each runs its own model predictive controller in a "
    "separate process.\n\n"
    "Start with: transport run paper",
    epilog="Exit codes: 0 done, 2 usage, 3 scenario, 4 peer lost or not reachable, "
    "5 deadlines missed, 6 diverged, 7 steps of a controller failed, 8 plans differ (replay), "
    "9 a check failed (doctor), "
    "10 not recorded, 11 collided, 130 interrupted.",
)


@cache
def command() -> Any:
    """Return the command `transport`, built once: processes forked later have it."""
    return typer.main.get_command(app)


def _version(is_given: bool) -> None:
    if is_given:
        from importlib import metadata  # 10 ms that other commands save

        typer.echo(f"transport {metadata.version('payload-transport')}")
        raise typer.Exit


@app.callback()
def options(
    version: bool = Option(
        False, "--version", help="Show the version and exit.", callback=_version, is_eager=True
    ),
) -> None:
    """Options without a command."""
