"""The commands `transport link`."""

import inspect
import json
from collections.abc import Iterator
from typing import Annotated, Any, Literal, get_origin

import typer
from typer import Option

from protocol.scenario.keys import key_of, meanings, unit_of
from protocol.scenario.link_sections import LinkSection
from protocol.scenario.links import PERFECT, LinkError, link_change
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.names import COORDINATOR, PLANT
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, with_options
from transport.cli.output import Format, exit_on, fail, show_json

# Placeholders of the options by the unit of their keys.
_METAVARS = {"s": "SECONDS", "1/s": "HZ", "": "PROBABILITY"}


def _options() -> Iterator[inspect.Parameter]:
    """Yield the options that set the keys of a link."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        if not (option := key_of(field).option):
            continue
        is_choice = get_origin(field.annotation) is Literal
        low, high = (next((getattr(e, end) for e in field.metadata if hasattr(e, end)), None) for end in ("ge", "le"))
        metavar = "NAME" if is_choice else _METAVARS[unit_of(name, field)]
        text = f"{meaning[name][0].upper()}{meaning[name][1:]}.".replace("`", "")
        kind: Any = Annotated[
            (str if is_choice else float) | None, Option(option, metavar=metavar, min=low, max=high, help=text)
        ]
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)


def _settings(**given: Any) -> dict[str, Any]:
    """Return the keys of a link whose options are given."""
    return {key: value for key, value in given.items() if value is not None}


_settings.__signature__ = inspect.Signature(list(_options()))  # type: ignore[attr-defined]


@with_options(_settings, ActiveRun)
def set_links(
    settings: dict[str, Any],
    run: ActiveRun,
    sender: Annotated[
        str | None, Option("--from", metavar="PROCESS", help="Sender: number of an agent, or plant; else all agents.")
    ] = None,
    receiver: Annotated[str | None, Option("--to", metavar="PROCESS", help="Receiver, in the same way.")] = None,
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1
    """
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
