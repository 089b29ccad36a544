"""Commands `link set` and `link clear`: impair the links of an active run, or repair them."""

import inspect
from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from typer import Option

from transport.cli.active import ActiveRunOption, process_name
from transport.cli.lazy import with_options
from transport.cli.options import FormatOption
from transport.cli.output import Format, fail, show
from transport.protocol.scenario.links.link_changes import PERFECT, split_groups
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.sections.scenario_keys import key_of, meanings, unit_of
from transport.protocol.wire.names import COORDINATOR


def _link_option_parameters() -> Iterator[inspect.Parameter]:
    """Yield a parameter for each key of a link that has an option."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        option = key_of(field).option
        if not option:
            continue

        kind: Any = _option_type(field.annotation)
        sentence = meaning[name]
        unit = unit_of(name, field)
        after = f", {unit}" if unit else ""
        text = f"{sentence[0].upper()}{sentence[1:]}{after}.".replace("`", "")
        yield inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[kind | None, Option(option, help=text)],
        )


def _option_type(annotation: Any) -> Any:
    """Return the type that an option has for a key: that of the key, without None and range.

    A choice of words is text: the section checks it, with an error like those of scenario files.
    """
    origin = get_origin(annotation)
    if origin is Literal:
        return str
    if origin is Annotated:
        return _option_type(get_args(annotation)[0])
    if origin in {Union, UnionType}:
        (given,) = (member for member in get_args(annotation) if member is not NoneType)
        return _option_type(given)
    return annotation


def _given_link_settings(**options: Any) -> dict[str, Any]:
    """Return the keys of a link whose options are given."""
    return {key: value for key, value in options.items() if value is not None}


# Typer sees the keys of `LinkSection` as options; `with_options` passes their values here.
_given_link_settings.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    list(_link_option_parameters())
)


@with_options(_given_link_settings, ActiveRunOption)
def set_links(
    settings: dict[str, Any],
    run: ActiveRunOption,
    sender: str | None = Option(
        None,
        "--from",
        metavar="PROCESS",
        help="Sender: number of an agent, or plant; else all agents.",
    ),
    receiver: str | None = Option(
        None, "--to", metavar="PROCESS", help="Receiver, in the same way."
    ),
    groups: str | None = Option(
        None,
        "--between",
        metavar="GROUPS",
        help="All links between groups of agents, both ways, in place of --from and --to: 1,2/3,4, "
        "or '1,2|3,4'.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1

    Example: transport link set --between 1,2/3,4 --loss 1
    """
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none")
    # An error of a value is told here already, before the run is asked.
    requested(LinkSection, settings)

    changed: dict[str, Any] = {}
    if sender is not None:
        changed["from"] = process_name(sender)
    if receiver is not None:
        changed["to"] = process_name(receiver)
    if groups is not None:
        changed["groups"] = _groups(groups)
    answer = run.ask(COORDINATOR, "link", {**changed, "settings": settings})
    show(output, answer, f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRunOption)
def clear_links(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
    """Remove all impairments, also from the plant's links.

    Example: transport link clear
    """
    answer = run.ask(COORDINATOR, "link", {"all": True, "settings": dict(PERFECT)})
    cleared = "all links: delay 0, loss 0, no other impairment"
    show(output, answer, f"{cleared}, from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def _groups(text: str) -> list[list[str]]:
    """Return the names of agents in groups, as `split_groups` reads them.

    A single group is refused.
    """
    groups = split_groups(text)
    if len(groups) < 2:
        expected = "expected groups with a slash or | between them, such as 1,2/3,4"
        fail(f"--between: {expected}, got {text}")
    return [[process_name(agent) for agent in group] for group in groups]
