"""Sections of the links: impairments, exceptions for single links, partitions, changes during a run."""

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from mpc.settings import NotNegative, Positive
from protocol.scenario.sections import Section
from protocol.wire.names import PLANT

Probability = Annotated[float, Field(ge=0.0, le=1.0)]


class GilbertElliottSection(Section):
    """Bursts of loss: a chain between a good state without and a bad state with loss, one step per tick."""

    enter: Probability
    leave: Probability
    loss: Probability = 1.0


class LinkSection(Section):
    """Impairments of a link: all random, in scenario time, independent for each message (but for bursts).

    The scale of the delay's random part is a width (uniform), standard deviation (normal, lognormal) or mean
    (exponential). The delay is never negative.
    """

    delay_s: NotNegative = 0.0  # fixed part of the delay
    jitter_s: NotNegative = 0.0  # scale of its random part
    distribution: Literal["uniform", "normal", "exponential", "lognormal", "empirical"] = "uniform"
    samples: str | None = None  # file of measured delays, which replace both parts with distribution "empirical"
    loss: Probability = 0.0  # that a message is lost
    gilbert_elliott: GilbertElliottSection | None = None  # bursts of loss
    duplicate: Probability = 0.0  # that a message arrives twice, each time with a delay of its own
    reorder: Probability = 0.0  # that a message is held back by `reorder_s` more
    reorder_s: NotNegative = 0.0
    # Messages per second of scenario time carried at most; those beyond are dropped.
    rate_hz: Positive | None = None

    @property
    def perfect(self) -> bool:
        """Return whether every message arrives at once, once."""
        return all(getattr(self, key) == field.default for key, field in LinkSection.model_fields.items())

    def settings(self) -> dict[str, Any]:
        """Return the keys of a link that were given, as plain data."""
        given = self.model_dump(mode="json", exclude_unset=True)
        return {key: value for key, value in given.items() if key in LinkSection.model_fields}


class LinkOverrideSection(LinkSection):
    """Impairments of the links from and to one process; an end left out means any agent."""

    from_: Annotated[str | None, Field(alias="from")] = None
    to: str | None = None

    def covers(self, sender: str, receiver: str) -> bool:
        """Return whether it applies to the link from one process to another; the plant has to be named."""
        ends = ((self.from_, sender), (self.to, receiver))
        return all(name == end if name is not None else end != PLANT for name, end in ends)


class LinkChangeSection(LinkOverrideSection):
    """Change of links during a run: the keys given apply to messages sent from `at_s` on, the others stay."""

    at_s: NotNegative

    @model_serializer(mode="wrap")
    def _given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return only the keys given: a default written out would be a change."""
        given = {*self.model_fields_set, *({"from"} if "from_" in self.model_fields_set else ())}
        return {key: value for key, value in dump(self).items() if key in given}


class PartitionSection(Section):
    """Interval in which no message passes between the named processes and the other agents."""

    between: Annotated[list[str], Field(min_length=1)]
    start_s: NotNegative
    end_s: Positive


class LinksSection(LinkSection):
    """The links between agents; measurement and actuation are those from and to the plant, ideal by default."""

    measurement: LinkSection = LinkSection()
    actuation: LinkSection = LinkSection()
    override: list[LinkOverrideSection] = []
    partition: list[PartitionSection] = []
    change: list[LinkChangeSection] = []

    def all(self) -> dict[str, LinkSection]:
        """Return every section of a link by its place below `links`, such as "override.1"."""
        overrides = {f"override.{i}": section for i, section in enumerate(self.override, start=1)}
        changes = {f"change.{i}": section for i, section in enumerate(self.change, start=1)}
        return {"": self, "measurement": self.measurement, "actuation": self.actuation, **overrides, **changes}
