"""Commands that act on a run in flight: links, faults, status."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from protocol.wire.exit_codes import EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.answers import fail

# What `transport run` chooses when nothing is said: the newest run that flies below this folder.
RUNS = Path("runs")

RunOption = Annotated[
    str | None,
    typer.Option("--run", help="Run folder, or name of a run; by default the newest below runs/ that flies."),
]
ConnectOption = Annotated[
    list[str] | None, typer.Option("--connect", help="Zenoh endpoint of one of its processes, with a run's name.")
]

KeysOption = Annotated[
    Path | None, typer.Option("--keys", help="Folder of keys, with --connect; a run's folder says where its are.")
]

link_app = typer.Typer(help="Change the links of a run in flight.", no_args_is_help=True)


@link_app.command("set")
def link_set(
    sender: Annotated[str | None, typer.Option("--from", help="Agent's number or plant; else any agent.")] = None,
    receiver: Annotated[str | None, typer.Option("--to", help="The same for the other end.")] = None,
    delay: Annotated[float | None, typer.Option("--delay", min=0.0, help="Fixed delay, s.")] = None,
    jitter: Annotated[float | None, typer.Option("--jitter", min=0.0, help="Scale of the random delay, s.")] = None,
    distribution: Annotated[str | None, typer.Option("--distribution", help="Of the random delay.")] = None,
    loss: Annotated[float | None, typer.Option("--loss", min=0.0, max=1.0, help="Probability of loss.")] = None,
    duplicate: Annotated[float | None, typer.Option("--duplicate", min=0.0, max=1.0, help="Of arriving twice.")] = None,
    reorder: Annotated[float | None, typer.Option("--reorder", min=0.0, max=1.0, help="Of being held back.")] = None,
    reorder_s: Annotated[float | None, typer.Option("--reorder-s", min=0.0, help="By how much more, s.")] = None,
    rate: Annotated[float | None, typer.Option("--rate", help="Messages per second at most.")] = None,
    run: RunOption = None,
    connect: ConnectOption = None,
    keys: KeysOption = None,
) -> None:
    """Impair or repair links from the next tick on.

    Keys that are not given stay as they are.

    Example: transport link set --from 1 --to 2 --delay 0.1
    """
    changes = {
        "delay_s": delay,
        "jitter_s": jitter,
        "distribution": distribution,
        "loss": loss,
        "duplicate": duplicate,
        "reorder": reorder,
        "reorder_s": reorder_s,
        "rate_hz": rate,
    }
    settings = {key: value for key, value in changes.items() if value is not None}
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none", EXIT_USAGE)
    ends = {"from": _process_name(sender), "to": _process_name(receiver)}
    answer = _ask(run, connect, keys, "coordinator", "link", {**ends, "settings": settings})
    typer.echo(f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@link_app.command("clear")
def link_clear(run: RunOption = None, connect: ConnectOption = None, keys: KeysOption = None) -> None:
    """Make all links perfect again, the plant's as well."""
    from transport.flight.requests import PERFECT

    for ends in ({}, {"from": "plant"}, {"to": "plant"}):
        answer = _ask(run, connect, keys, "coordinator", "link", {**ends, "settings": dict(PERFECT)})
    typer.echo(f"links are perfect from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def fault(
    action: Annotated[str, typer.Argument(help="kill, stop, continue or restart.")],
    target: Annotated[str, typer.Argument(help="Process: agent1, agent2, ..., plant, coordinator.")],
    run: RunOption = None,
    connect: ConnectOption = None,
    keys: KeysOption = None,
) -> None:
    """Kill, stop, continue or restart a process of a run in flight.

    It is noted in the run's log.

    Example: transport fault kill agent3
    """
    answer = _ask(run, connect, keys, "recorder", "fault", {"do": action, "target": target})
    typer.echo(f"{action} {target}: done at tick {answer['tick']}")


def status(
    process: Annotated[
        str | None,
        typer.Option("--process", help="Say how this process is instead: coordinator, plant, agent1, ..., recorder."),
    ] = None,
    run: RunOption = None,
    connect: ConnectOption = None,
    keys: KeysOption = None,
) -> None:
    """Say how far a run in flight is, or how a process is.

    As JSON: tick and who takes part; with --process what that one uses and has refused.
    """
    name, what = ("coordinator", "status") if process is None else (process, "health")
    typer.echo(json.dumps(_ask(run, connect, keys, name, what, {})))


def _process_name(end: str | None) -> str:
    """A process name from what people write: 2, agent2, plant, or nothing for any agent."""
    return "" if end is None else f"agent{end}" if end.isdecimal() else end


def _ask(
    run: str | None, connect: list[str] | None, keys: Path | None, name: str, what: str, given: dict[str, Any]
) -> dict[str, Any]:
    from protocol.wire.keys import Keys
    from transport.flight import live
    from transport.flight.requests import RefusedError, UnansweredError, request

    if connect and not (run and Keys.allows(run)):
        fail(f"--run: expected the name of a run with --connect, got {run!r}", EXIT_USAGE)
    if connect and run:
        known, endpoints = run, connect
    else:
        there = live.newest(RUNS) if run is None else live.read(Path(run)) or live.read(RUNS / run)
        if there is None:
            where = f"below {RUNS}/" if run is None else f"in {run}"
            fail(f"no run that flies {where}; name its folder with --run, or its endpoints with --connect", EXIT_USAGE)
        if name not in there.endpoints:
            fail(f"--process: expected one of {', '.join(there.endpoints)}, got {name!r}", EXIT_USAGE)
        # Only the one that is asked: others may be frozen, and then take their time.
        known, endpoints = there.run, [there.endpoints[name]]
        keys = keys or (Path(there.keys) if there.keys else None)
    try:
        return request(known, endpoints, name, what, given, keys=keys)
    except UnansweredError as error:
        fail(str(error), EXIT_UNREACHABLE)
    except RefusedError as error:
        fail(str(error), EXIT_USAGE)
