"""The command `transport`: the tables of its commands, and what it answers without one."""

from importlib import metadata
from typing import Annotated

import typer
from typer import Option

from transport.cli.lazy import lazy_group

app = lazy_group(
    {
        "run": ("transport.cli.run:run", "Run a scenario with all its processes; record and report it."),
        "validate": ("transport.cli.scenario:validate", "Check a scenario and print it with every default."),
        "margins": ("transport.cli.margins:margins", "Compute how much model error a hover tolerates."),
        "plot": ("transport.cli.plot:plot", "Regenerate metrics and figures of a recorded run."),
        "view": ("transport.cli.view:view", "Show a recorded or active run in the browser."),
        "compare": ("transport.cli.compare:compare", "Compare recorded runs in a table and in figures."),
        "replay": ("transport.cli.replay:replay", "Feed a recorded run to one agent and compare its plans."),
        "top": ("transport.cli.top:top", "Watch the agents of an active run."),
        "status": ("transport.cli.operate:status", "Show the progress of a run, or the health of one process."),
        "fault": ("transport.cli.operate:fault", "Kill, stop, continue or restart a process of an active run."),
        "target": ("transport.cli.operate:target", "Send the payload of an active run to a target."),
        "doctor": ("transport.cli.doctor:doctor", "Check that this machine can run a scenario."),
        "agent": ("transport.cli.processes:agent", "Run one agent: the controller of the UAVs it owns."),
        "plant": ("transport.cli.processes:plant", "Run the plant: dynamics and actuators."),
        "coordinator": ("transport.cli.processes:coordinator", "Run the coordinator: sampling clock and roster."),
        "record": ("transport.cli.processes:record", "Record and report a run whose processes were started by hand."),
        "router": ("transport.cli.processes:router", "Route messages between hosts without a direct connection."),
        "metrics": ("transport.cli.operate:metrics", "Export process metrics to Prometheus."),
        "ros2": ("transport.cli.ros2:ros2", "Publish an active run for ROS 2 over rmw_zenoh."),
    },
    {
        "Simulate": ["run", "experiment", "scenario", "validate", "margins", "doctor"],
        "Look at runs": ["view", "plot", "compare", "log", "replay"],
        "Act on an active run": ["top", "status", "target", "link", "fault"],
        "Start processes by hand": ["coordinator", "plant", "agent", "record"],
        "Connect hosts": ["deploy", "router", "metrics", "ros2"],
    },
    name="transport",
    add_completion=True,
    help="Several UAVs carry one payload; each runs its own model predictive controller in a separate process.\n\n"
    "Start with: transport run paper",
    epilog="Exit codes: 0 done, 2 usage, 3 scenario, 4 peer lost or not reachable, "
    "5 deadlines missed, 6 diverged, 8 plans differ (replay), 9 a check failed (doctor), "
    "10 not recorded, 130 interrupted.",
)
app.add_typer(
    lazy_group(
        {
            "set": ("transport.cli.operate:set_links", "Impair or repair links from the next tick on."),
            "clear": ("transport.cli.operate:clear_links", "Remove all impairments, also from the plant's links."),
        },
        help="Change the links of an active run.",
    ),
    name="link",
)
app.add_typer(
    lazy_group(
        {
            "latency": ("transport.cli.experiment:latency", "Effect of a fixed delay on every link."),
            "loss": ("transport.cli.experiment:loss", "Effect of packet loss, independent or in bursts."),
            "jitter": ("transport.cli.experiment:jitter", "Effect of the distribution of random delays."),
            "kill": ("transport.cli.experiment:kill", "Effect of the death of each agent."),
            "deaths": ("transport.cli.experiment:deaths", "Effect of a permanent kill of a random agent."),
            "matrix": ("transport.cli.experiment:matrix", "Maps of cost and completion over delay and loss."),
            "ablation": ("transport.cli.experiment:ablation", "Contribution of each part of the algorithm."),
            "horizon": ("transport.cli.experiment:horizon", "Effect of horizon and terminal weight."),
            "hover": ("transport.cli.experiment:hover", "Stability in a long hover after the maneuver."),
            "sharing": ("transport.cli.experiment:sharing", "Cost against the number of plans sent."),
            "agile": ("transport.cli.experiment:agile", "Fast flight: the payload's error over speed."),
            "paper": ("transport.cli.experiment:paper", "The paper's claim: centralized against distributed."),
            "scaling": ("transport.cli.experiment:scaling", "Growth of cost, computation and messages."),
        },
        help="Simulate many variations of a scenario and compare them.\n\n"
        "Prints a table and confidence intervals; writes tables and a figure.",
        epilog="Exit codes: 0 done, whatever the result; 2 usage, 3 scenario, 4 cluster or worker lost, "
        "7 some simulations raised an error, 130 interrupted.",
    ),
    name="experiment",
)
app.add_typer(
    lazy_group(
        {"new": ("transport.cli.scenario:new", "Write a scenario for a team of any size.")}, help="Create scenarios."
    ),
    name="scenario",
)
app.add_typer(
    lazy_group(
        {
            "info": ("transport.cli.log:info", "Describe the content of a log, and its gaps."),
            "export": ("transport.cli.log:export", "Write a log as tables, for Foxglove, or as a bag for ROS 2."),
        },
        help="Describe and export the log of a run.",
        epilog="Exit codes: 0 done, also for an incomplete log; 2 the log cannot be read.",
    ),
    name="log",
)
app.add_typer(
    lazy_group(
        {
            "keys": ("transport.cli.deploy:keys", "Create a certificate authority and process certificates."),
            "render": ("transport.cli.deploy:render", "Write one deployment folder per host."),
        },
        help="Deploy a run to several hosts.",
    ),
    name="deploy",
)


def _version(is_given: bool) -> None:
    if is_given:
        typer.echo(f"transport {metadata.version('payload-transport')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, Option("--version", help="Show the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Options without a command."""
