"""Changes of links during a run: requests, messages of the coordinator, and the same in words."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.sections.link_sections import (
    LinkOverrideSection,
    LinkSection,
    LinksSection,
)
from transport.protocol.scenario.sections.scenario_errors import RequestError, requested
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import LinkChange

# Settings of a link that make it perfect: the defaults.
PERFECT: Mapping[str, Any] = {key: field.default for key, field in LinkSection.model_fields.items()}

_LONGEST_SHOWN = 60  # characters of a request that an error repeats


class LinkChanges:
    """Changes of the links of one receiver during a run, each applied once and in order."""

    def __init__(self, links: Iterable[Link]) -> None:
        self._links = tuple(links)
        self._applied = 0  # changes so far; the next one has the number after it

    def check(self, message: LinkChange) -> LinkOverrideSection:
        """Return a change.

        Raises: MessageError: it is invalid, or neither the next one nor one that is repeated.
        """
        if message.number > self._applied + 1:
            text = f"change {message.number} of the links after {self._applied}"
            raise MessageError("future", text)
        return link_change(message.source, message.target, message.settings)

    def apply(self, message: LinkChange) -> None:
        """Apply a change, unless it was repeated for a process that has just joined."""
        if message.number != self._applied + 1:
            return

        change = self.check(message)
        self._applied += 1
        for link in self._links:
            link.change(message.tick, change)


def link_change(source: str, target: str, settings: str) -> LinkOverrideSection:
    """Return a change of links from its ends, empty for any agent, and a JSON object of keys.

    Raises: RequestError: it is invalid.
    """
    try:
        given = json.loads(settings)
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict):
        expected = "expected a JSON object of a link's keys"
        raise RequestError(f"{expected}, got {settings[:_LONGEST_SHOWN]!r}")

    ends = {"from": source, "to": target}
    named = {key: name for key, name in ends.items() if name}
    return requested(LinkOverrideSection, {**given, **named})


def scripted_changes(links: LinksSection) -> Iterator[tuple[float, str]]:
    """Yield times, s, and words of the changes and partitions that a scenario has."""
    for change in links.change:
        ends = change.from_ or "", change.to or ""
        yield change.at_s, change_in_words(*ends, change.settings())
    for partition in links.partition:
        group = ", ".join(partition.between)
        yield partition.start_s, f"{group} cut off"
        yield partition.end_s, f"{group} connected again"


def words_of(change: LinkChange) -> str:
    """Return the change in a coordinator's message in words; an invalid one as it is."""
    try:
        settings = link_change(change.source, change.target, change.settings).settings()
    except RequestError:
        return f"links: {change.settings}"
    return change_in_words(change.source, change.target, settings)


def change_in_words(source: str, target: str, settings: Mapping[str, Any]) -> str:
    """Return a change in words; an empty end is any agent.

    An example is "links from agent1 to agent2: delay_s 0.2, loss 0.3".
    """
    sender = f" from {source}" if source else ""
    receiver = f" to {target}" if target else ""
    links = f"links{sender}{receiver}" if source or target else "links between agents"
    return changed_in_words(links, settings)


def changed_in_words(links: str, settings: Mapping[str, Any]) -> str:
    """Return the change of some links, in words, in words."""
    if PERFECT.items() <= settings.items():
        return f"{links} cleared"
    values = ", ".join(f"{key} {value!s:.40}" for key, value in settings.items())
    return f"{links}: {values}"


def split_groups(text: str) -> list[list[str]]:
    """Return the agents of each group in a text such as "1,2/3,4".

    Between groups is a slash, or a bar, which a shell would take as a pipe; between agents a comma
    or blanks.
    """
    return [group.replace(",", " ").split() for group in re.split("[/|]", text)]
