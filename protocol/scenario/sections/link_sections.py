"""Sections of the links: impairments, exceptions, partitions, changes during a run."""

import math
from typing import Annotated, Any, Literal, Self

from annotated_types import Interval
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from transport.model.section import Key, NotNegative, Positive, Section
from transport.protocol.scenario.files.named_files import TableError, delays_of, trace_of
from transport.protocol.wire.names import PLANT

Probability = Annotated[float, Interval(ge=0.0, le=1.0)]

# Longest delay in seconds that is taken for one without question: delays in ms are mostly larger.
LONGEST_SAMPLE_S = 10.0
_DELAY_S = (1e-9, LONGEST_SAMPLE_S)

_PROCESS = "agent1, agent2, ..., plant"


def _read_samples(value: Any, info: ValidationInfo) -> Any:
    """Return the delays in the file that a scenario names, else the value as it is.

    The name is relative to the scenario's folder, `info.context`. Without a folder, as in a request
    during a run, the value passes unread.
    """
    if isinstance(value, str) and info.context is not None:
        return delays_of(info.context / value)
    return value


def _read_trace(value: Any, info: ValidationInfo) -> Any:
    """Return the rows in a file of a trace, as `_read_samples` does of delays."""
    if isinstance(value, str) and info.context is not None:
        path = info.context / value
        rows = trace_of(path)
        try:
            return _checked_trace(rows, first_row=2)  # after the heading
        except ValueError as error:
            raise TableError(f"{path}: {error}") from error
    return value


def _checked_trace(
    rows: list[list[float]] | None, *, first_row: int = 1
) -> list[list[float]] | None:
    """Return the rows of a trace.

    Raises: ValueError: too few, bad, not in the order of times, or with delays in milliseconds.
    """
    if rows is None:
        return None
    if len(rows) < 2:
        raise ValueError(f"expected at least two rows of a time and a delay, got {len(rows)}")

    before_s = -math.inf
    for number, row in enumerate(rows, start=first_row):
        if len(row) != 2:
            raise ValueError(f"row {number}: expected a time and a delay, got {row}")
        time_s, delay_s = row
        if time_s < 0.0 or time_s <= before_s:
            raise ValueError(f"row {number}: expected rising times from 0 on, got {time_s:g} s")
        if delay_s > LONGEST_SAMPLE_S:
            expected = f"expected seconds, at most {LONGEST_SAMPLE_S:g}, got {delay_s:g}"
            meant_s = delay_s / 1000.0
            raise ValueError(f"row {number}: {expected}: did you mean {meant_s:g}?")
        before_s = time_s
    return rows


class GilbertElliottSection(Section):
    """Bursts of loss: a chain of a good state and a bad one with loss, one step per tick."""

    enter: Probability
    """probability per tick of going bad"""
    leave: Probability
    """probability per tick of recovering"""
    loss: Probability = 1.0
    """probability of loss while bad"""


class LinkSection(Section):
    """Impairments of a link, in scenario time; apart from bursts independent for each message."""

    delay_s: Annotated[
        NotNegative,
        Key(within=_DELAY_S, label="delay of plans", shown="ms", option="--delay", short="delay_s"),
    ] = 0.0
    """fixed part of the delay"""
    jitter_s: Annotated[
        NotNegative,
        Key(
            within=_DELAY_S,
            label="jitter of plans",
            shown="ms",
            option="--jitter",
            short="jitter_s",
        ),
    ] = 0.0
    """scale of the random part of the delay: width (uniform, centred on `delay_s`), standard
    deviation (normal, lognormal), mean (exponential); delays below 0 become 0"""
    distribution: Annotated[
        Literal["uniform", "normal", "exponential", "lognormal", "empirical"],
        Key(label="delay distribution", option="--distribution"),
    ] = "uniform"
    """distribution of the random part of the delay; empirical draws whole delays from
    `samples_s`"""
    samples_s: Annotated[
        list[NotNegative] | None,
        BeforeValidator(_read_samples),
        Key(type="file, or list of numbers >= 0"),
    ] = None
    """measured delays for empirical, or a file of them, separated by blanks or commas, relative to
    the scenario's folder (in `--set`: to the current one), which becomes part of the scenario when
    that is read"""
    longest_sample_s: Annotated[Positive | None, Key(type="number > 0")] = None
    """largest delay that `samples_s` may have. If omitted, 10 s: longer ones are mostly
    milliseconds"""
    trace: Annotated[
        list[list[float]] | None,
        BeforeValidator(_read_trace),
        AfterValidator(_checked_trace),
        Key(type="file, or rows of 2 numbers", unit="s"),
    ] = None
    """recorded delays in the place of `delay_s` and `distribution`: rows of a time and the delay of a message sent from
    then on, negative if it was lost, or a CSV file of them, `t_s,delay_s`, with `lost` for a lost one
    ([radio.md](../radio.md#a-recorded-link)); it begins with the run and is repeated"""
    loss: Annotated[
        Probability, Key(label="loss of plans", shown="%", option="--loss", short="loss")
    ] = 0.0
    """probability that a message is lost, independent for each message"""
    gilbert_elliott: GilbertElliottSection | None = None
    duplicate: Annotated[
        Probability, Key(label="duplicated plans", shown="%", option="--duplicate")
    ] = 0.0
    """probability that a message arrives a second time, with a separate delay"""
    reorder: Annotated[Probability, Key(label="plans held back", shown="%", option="--reorder")] = (
        0.0
    )
    """probability that a message is held back by `reorder_s`"""
    reorder_s: Annotated[
        NotNegative,
        Key(
            within=_DELAY_S,
            label="extra delay of plans held back",
            shown="ms",
            option="--reorder-s",
        ),
    ] = 0.0
    """extra delay of a message that is held back"""
    rate_hz: Annotated[
        Positive | None, Key(label="plans per second on a link", option="--rate")
    ] = None
    """messages per second of scenario time that the link carries, evenly spread: half of 1 / T_s
    drops every other"""

    @model_validator(mode="after")
    def _has_samples(self) -> Self:
        if self.distribution == "empirical" and not self.samples_s:
            raise ValueError("samples_s: expected measured delays beside empirical, got nothing")
        return self

    @model_validator(mode="after")
    def _has_samples_in_seconds(self) -> Self:
        """Refuse delays with the magnitude of another unit, unless they are said to be meant."""
        longest_s = max(self.samples_s or [0.0])
        limit_s = self.longest_sample_s or LONGEST_SAMPLE_S
        if longest_s > limit_s:
            expected = f"samples_s: expected delays in seconds, at most {limit_s:g}"
            remedy = "divide milliseconds by 1000; if seconds are meant, set longest_sample_s"
            raise ValueError(f"{expected}, got {longest_s:g}; {remedy} = {longest_s:g}")
        return self

    @property
    def perfect(self) -> bool:
        """Return whether all keys have their defaults: every message arrives at once, once."""
        fields = LinkSection.model_fields
        return all(getattr(self, key) == field.default for key, field in fields.items())

    def settings(self) -> dict[str, Any]:
        """Return the keys of a link that were given, as plain data."""
        return self.model_dump(
            mode="json", exclude_unset=True, include=set(LinkSection.model_fields)
        )


class LinkOverrideSection(LinkSection):
    """Impairments of the links from and to one process; an end left out means any agent."""

    from_: Annotated[str | None, Key(type=_PROCESS), Field(alias="from")] = None
    """sender; if omitted: any agent"""
    to: Annotated[str | None, Key(type=_PROCESS)] = None
    """receiver; if omitted: any agent"""

    @model_validator(mode="after")
    def _has_two_ends(self) -> Self:
        if self.to is not None and self.from_ == self.to:
            raise ValueError(f"to: expected another process than the sender, got {self.to!r} twice")
        return self

    def covers(self, sender: str, receiver: str) -> bool:
        """Return whether it applies to a link; to one of the plant only if it names the plant."""
        return _is_end(self.from_, sender) and _is_end(self.to, receiver)


def _is_end(name: str | None, process: str) -> bool:
    """Return whether a process is a named end of a link, or any agent if no name is given."""
    if name is None:
        return process != PLANT
    return process == name


class LinkChangeSection(LinkOverrideSection):
    """Change of links during a run: its keys apply to messages sent from `at_s` on."""

    at_s: NotNegative
    """time of the change: it applies to messages of the first tick not before it, and of later
    ticks"""

    @model_validator(mode="after")
    def _gives_values(self) -> Self:
        """Refuse a key without value: the record of the run would lack the change."""
        for key in sorted(LinkSection.model_fields.keys() & self.model_fields_set):
            if getattr(self, key) is None:
                raise ValueError(f"{key}: expected a value, got None")
        return self

    @model_serializer(mode="wrap")
    def _given_keys(
        self, dump: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """Return only the keys given: a default written out would be a change.

        A default given is one, too, such as the loss of 0 that ends a silence: it stays where
        defaults are left out.
        """
        given = set(self.model_fields_set)
        if "from_" in given:
            given.add("from")  # dumped under its alias
        tree = {key: value for key, value in dump(self).items() if key in given}
        if info.exclude_defaults:
            impairments = LinkSection.model_fields.keys() & given
            tree |= {name: getattr(self, name) for name in sorted(impairments - tree.keys())}
        return tree


class PartitionSection(Section):
    """Interval in which no message passes between the named processes and the other agents."""

    between: Annotated[list[str], Field(min_length=1), Key(type=f"list of {_PROCESS}")]
    """processes of one side: no message passes between them and those not in the list; the links to
    the plant change only if it is in the list"""
    start_s: NotNegative
    """first time of sending"""
    end_s: Annotated[Positive, Key(type="number > `start_s`, s", unit="")]
    """time of sending at which messages pass again"""


class LinksSection(LinkSection):
    """The links between agents, and, ideal by default, those from and to the plant."""

    measurement: LinkSection = LinkSection()
    """links from the plant to the agents"""
    actuation: LinkSection = LinkSection()
    """links from the agents to the plant"""
    override: list[LinkOverrideSection] = []
    """exceptions: the last one that covers a link is all of its impairments"""
    partition: list[PartitionSection] = []
    """intervals in which processes are cut off"""
    change: list[LinkChangeSection] = []
    """changes during the run, in any order"""
