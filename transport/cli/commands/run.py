"""Command `transport run`.

The scenario is read first; then this process is forked into the fork server, and imports what only the
command needs while the server starts to work.
"""

import socket
from itertools import chain
from pathlib import Path

import typer
from typer import Option

from transport.cli import options
from transport.cli.hosts.fork_server_process import serve_processes
from transport.cli.lazy import load
from transport.cli.output import Format, fail
from transport.flight.fork_server import fork_into_server
from transport.mpc.settings_period_horizon_weights import AloneGains
from transport.protocol.network.mesh import process_names
from transport.protocol.scenario.checks.relations import after_the_end
from transport.protocol.scenario.setup.acting_alone import lacks
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.names import COORDINATOR


def run(
    scenario: options.ScenarioArgument = "paper",
    settings: options.SetOption = None,
    out: Path | None = Option(
        None, metavar="FOLDER", help="Run folder to create; by default runs/<time>-<scenario>."
    ),
    output: options.FormatOption = Format.text,
    figures: options.FiguresOption = True,
    external: list[str] | None = Option(
        None, metavar="NAME", help="Process that you start yourself: plant, agent1, ... Repeatable."
    ),
    view: bool = Option(False, "--view", help="Show the run in the browser, live and afterwards."),
    host: options.HostOption = "127.0.0.1",
    port: options.PortOption = 8080,
    allow_large: options.LargeOption = False,
) -> None:
    """Run a scenario with all its processes; record and report it.

    Starts one process per agent, a plant and a coordinator; writes log, metrics and figures to a
    run folder.

    Example: transport run paper --set controller.relaxation=0.5 --out runs/relaxed
    """
    setup = options.read_setup(scenario, settings, allow_large=allow_large)
    _check_external(setup, external or [])
    for problem in chain(after_the_end(setup.scenario), lacks(setup.alone)):
        typer.echo(f"warning: {problem}", err=True)
    if setup.alone is not None and setup.alone.gains != AloneGains():
        typer.echo(f"UAVs alone: {setup.alone.in_words()}", err=True)

    fork_into_server(_serve)
    local_run = load("transport.cli.local_run")
    viewer = (host, port) if view else None
    code = local_run.run_and_report(setup, out, external or [], output, viewer, figures=figures)
    raise typer.Exit(code)


def _serve(requests: socket.socket) -> None:
    """Be the fork server of this run, whose processes begin as the command does."""
    from transport.__main__ import main

    serve_processes(requests, main)


def _check_external(setup: Setup, external: list[str]) -> None:
    """End the command if a process that is not to be started does not exist.

    Scripted faults act only on processes of the run, so one with faults is refused, too.
    """
    names = [name for name in process_names(setup.scenario) if name != COORDINATOR]
    for name in external:
        if name not in names:
            fail(f"--external: expected one of {', '.join(names)}, got {name!r}")

        if any(fault.target == name for fault in setup.faults):
            expected = "a process without scripted faults, which act only on processes of the run"
            fail(f"--external: expected {expected}, got {name!r}")
