"""The commands `transport link`."""

import json
from typing import Annotated

import typer
from typer import Option

from protocol.scenario.link_words import PERFECT
from protocol.scenario.links import LinkError, link_change
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.names import COORDINATOR, PLANT
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, with_options
from transport.cli.output import Format, exit_on, fail, show_json


@with_options(ActiveRun)
def set_links(
    run: ActiveRun,
    sender: Annotated[
        str | None, Option("--from", metavar="PROCESS", help="Sender: number of an agent, or plant; else all agents.")
    ] = None,
    receiver: Annotated[str | None, Option("--to", metavar="PROCESS", help="Receiver, in the same way.")] = None,
    delay_s: Annotated[float | None, Option("--delay", metavar="SECONDS", min=0.0, help="Fixed delay, s.")] = None,
    jitter_s: Annotated[
        float | None, Option("--jitter", metavar="SECONDS", min=0.0, help="Scale of the random delay, s.")
    ] = None,
    distribution: Annotated[
        str | None,
        Option("--distribution", metavar="NAME", help="Distribution of the random delay (docs/keys.md)."),
    ] = None,
    loss: Annotated[
        float | None, Option("--loss", metavar="PROBABILITY", min=0.0, max=1.0, help="Probability of packet loss.")
    ] = None,
    duplicate: Annotated[
        float | None, Option("--duplicate", metavar="PROBABILITY", min=0.0, max=1.0, help="Probability of duplication.")
    ] = None,
    reorder: Annotated[
        float | None, Option("--reorder", metavar="PROBABILITY", min=0.0, max=1.0, help="Probability of reordering.")
    ] = None,
    reorder_s: Annotated[
        float | None, Option("--reorder-s", metavar="SECONDS", min=0.0, help="Extra delay of reordered messages, s.")
    ] = None,
    rate_hz: Annotated[
        float | None, Option("--rate", metavar="HZ", help="Maximum number of messages per second.")
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1
    """
    changes = {
        "delay_s": delay_s,
        "jitter_s": jitter_s,
        "distribution": distribution,
        "loss": loss,
        "duplicate": duplicate,
        "reorder": reorder,
        "reorder_s": reorder_s,
        "rate_hz": rate_hz,
    }
    settings = {key: value for key, value in changes.items() if value is not None}
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none", EXIT_USAGE)
    with exit_on(LinkError, code=EXIT_USAGE):
        link_change("", "", json.dumps(settings))
    ends = {"from": _process_name(sender), "to": _process_name(receiver)}
    answer = run.ask(COORDINATOR, "link", {**ends, "settings": settings})
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRun)
def clear_links(run: ActiveRun, output: FormatOption = Format.text) -> None:
    """Remove all impairments, also from the plant's links.

    Example: transport link clear
    """
    for ends in ({}, {"from": PLANT}, {"to": PLANT}):
        answer = run.ask(COORDINATOR, "link", {**ends, "settings": dict(PERFECT)})
    if output is Format.json:
        show_json(answer)
        return
    cleared = "all links: delay 0, loss 0, no other impairment"
    typer.echo(f"{cleared}, from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def _process_name(end: str | None) -> str:
    """Return the name of a process given as 2, agent2 or plant; empty for all agents."""
    return "" if end is None else f"agent{end}" if end.isdecimal() else end
