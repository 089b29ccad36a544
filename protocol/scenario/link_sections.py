"""Sections of the links: impairments, exceptions for single links, partitions, changes during a run."""

from typing import Annotated, Any, Literal, Self

from annotated_types import Interval
from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from transport.mpc.settings import Key, NotNegative, Positive, Section
from transport.protocol.scenario.files import delays_of
from transport.protocol.wire.names import PLANT

Probability = Annotated[float, Interval(ge=0.0, le=1.0)]

_PROCESS = "agent1, agent2, ..., plant"


def _read(value: Any, info: ValidationInfo) -> Any:
    """Return the content of a file of a scenario, which has a folder; a change during a run has none."""
    return (
        delays_of(info.context / value)
        if isinstance(value, str) and info.context is not None
        else value
    )


class GilbertElliottSection(Section):
    """Bursts of loss: a chain between a good state without and a bad state with loss, one step per tick."""

    enter: Probability
    """probability per tick of going bad"""
    leave: Probability
    """probability per tick of recovering"""
    loss: Probability = 1.0
    """probability of loss while bad"""


class LinkSection(Section):
    """Impairments of a link, in scenario time, independent for each message but for bursts; none by default."""

    delay_s: Annotated[
        NotNegative, Key(label="delay of plans", shown="ms", option="--delay", short="delay_s")
    ] = 0.0
    """fixed part of the delay"""
    jitter_s: Annotated[
        NotNegative, Key(label="jitter of plans", shown="ms", option="--jitter", short="jitter_s")
    ] = 0.0
    """scale of the random part of the delay: width (uniform, centred on `delay_s`), standard deviation (normal,
    lognormal), mean (exponential); delays below 0 become 0"""
    distribution: Annotated[
        Literal["uniform", "normal", "exponential", "lognormal", "empirical"],
        Key(label="delay distribution", option="--distribution"),
    ] = "uniform"
    """distribution of the random part of the delay; empirical draws whole delays from `samples`"""
    samples: Annotated[
        list[NotNegative] | None, BeforeValidator(_read), Key(type="file, or list of numbers >= 0")
    ] = None
    """measured delays for empirical, or a file of them, separated by blanks or commas, relative to the scenario's
    folder (in `--set`: to the current one), which becomes part of the scenario when that is read"""
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
        NotNegative, Key(label="extra delay of plans held back", shown="ms", option="--reorder-s")
    ] = 0.0
    """extra delay of a message that is held back"""
    rate_hz: Annotated[
        Positive | None, Key(label="plans per second on a link", option="--rate")
    ] = None
    """messages per second of scenario time that the link carries, evenly spread: half of 1 / T_s drops every other"""

    @model_validator(mode="after")
    def _has_samples(self) -> Self:
        if self.distribution == "empirical" and not self.samples:
            raise ValueError("samples: expected measured delays, got nothing")
        return self

    @property
    def perfect(self) -> bool:
        """Return whether every message arrives at once, once."""
        return all(
            getattr(self, key) == field.default for key, field in LinkSection.model_fields.items()
        )

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

    def covers(self, sender: str, receiver: str) -> bool:
        """Return whether it applies to the link from one process to another; the plant has to be named."""
        ends = ((self.from_, sender), (self.to, receiver))
        return all(name == end if name is not None else end != PLANT for name, end in ends)


class LinkChangeSection(LinkOverrideSection):
    """Change of links during a run: the keys given apply to messages sent from `at_s` on, the others stay."""

    at_s: NotNegative
    """time of the change: it applies to messages of the first tick not before it, and of later ticks"""

    @model_serializer(mode="wrap")
    def _given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return only the keys given: a default written out would be a change."""
        given = {*self.model_fields_set, *({"from"} if "from_" in self.model_fields_set else ())}
        return {key: value for key, value in dump(self).items() if key in given}


class PartitionSection(Section):
    """Interval in which no message passes between the named processes and the other agents."""

    between: Annotated[list[str], Field(min_length=1), Key(type=f"list of {_PROCESS}")]
    """processes of one side: no message passes between them and those not in the list; the links to the plant change
    only if it is in the list"""
    start_s: NotNegative
    """first time of sending"""
    end_s: Annotated[Positive, Key(type="number > `start_s`, s", unit="")]
    """time of sending at which messages pass again"""


class LinksSection(LinkSection):
    """The links between agents; measurement and actuation are those from and to the plant, ideal by default."""

    measurement: LinkSection = LinkSection()
    actuation: LinkSection = LinkSection()
    override: list[LinkOverrideSection] = []
    partition: list[PartitionSection] = []
    change: list[LinkChangeSection] = []
