"""Changes of links during a run are applied once, in the order of time, by the receiver."""

import json
from typing import Any

import pytest

from tests.support.runs import setup
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.links.link_changes import LinkChanges, link_change
from transport.protocol.scenario.sections.link_sections import LinkChangeSection
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import LinkChange

SAMPLES = {"a.csv": (0.1, 0.2), "b.csv": (0.3,)}


def links(*settings: str) -> dict[str, Link]:
    """The links to agent 1, by sender."""
    run = setup(*settings)
    return {sender: run.rules.link(sender, "agent1") for sender in ("agent2", "agent3", "plant")}


def change(
    number: int, tick: int, source: str = "", target: str = "", **settings: Any
) -> LinkChange:
    """Message of the coordinator that changes links from a tick on."""
    return LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=number,
        tick=tick,
        number=number,
        source=source,
        target=target,
        settings=json.dumps(settings),
    )


def told(found: dict[str, Link], *changes: LinkChange) -> dict[str, Link]:
    """The links after some changes."""
    changed = LinkChanges(found.values())
    for message in changes:
        changed.apply(message)
    return found


def losses(found: dict[str, Link], tick: int) -> list[float]:
    """Probability of loss of each of the links."""
    return [one.impairments(tick).loss for one in found.values()]


def test_told_again() -> None:
    """All changes are repeated for a process that joins: known ones, by number, have no effect."""
    once = change(1, 5, loss=0.5)
    twice = told(
        links(), once, change(2, 6, loss=0.7), once, change(1, 9, loss=1.0), change(2, 6, loss=0.7)
    )
    assert [losses(twice, tick)[0] for tick in (4, 5, 6, 100)] == [0.0, 0.5, 0.7, 0.7]


def test_scripted_changes_stay_where_they_are() -> None:
    """A change by hand neither advances nor undoes the later changes of the scenario."""
    found = told(links("links.change=[{at_s=2.0,delay_s=0.5}]"), change(1, 10, loss=0.3))
    models = [found["agent2"].impairments(tick) for tick in (9, 10, 39, 40, 100)]
    assert [model.loss for model in models] == [0.0, 0.3, 0.3, 0.3, 0.3]
    assert [model.delay_s for model in models] == [0.0, 0.0, 0.0, 0.5, 0.5]


@pytest.mark.parametrize(
    ("before", "given", "after"),
    [
        ("links={distribution='exponential',jitter_s=0.1}", "delay_s=0.2", "exponential"),
        ("links={distribution='empirical',samples_s=[0.1]}", "delay_s=0.2", "uniform"),
        (
            "links={distribution='empirical',samples_s=[0.1]}",
            "delay_s=0.2,distribution='normal'",
            "normal",
        ),
    ],
)
def test_only_measured_delays_end_with_another_delay(before: str, given: str, after: str) -> None:
    """The distribution stays, but that of measured delays, unless the change gives one."""
    found = links(before, f"links.change=[{{at_s=0.5,{given}}}]")["agent2"].impairments(10)
    assert (found.delay_s, found.distribution) == (0.2, after)


WRONG = [
    "",
    "[]",
    "[" * 999,
    '{"los": 0.1}',
    '{"loss": 1.5}',
    '{"loss": NaN}',
    '{"gilbert_elliott": {"enter": 0.1}}',
    '{"at_s": 1.0}',
    '{"distribution": "empirical"}',
]


@pytest.mark.parametrize("key", ["rate_hz", "gilbert_elliott"])
def test_a_change_of_a_scenario_has_values(key: str) -> None:
    """A key without value, which the record of a run would leave out, is refused."""
    with pytest.raises(ValueError, match=f"{key}: expected a value, got None"):
        LinkChangeSection.model_validate({"at_s": 1.0, key: None})


@pytest.mark.parametrize("settings", WRONG)
def test_what_is_no_change_is_refused(settings: str) -> None:
    """Anything but a JSON object of a link's keys is refused on one line, without effect, and does not count."""
    with pytest.raises(RequestError) as caught:
        link_change("", "", settings)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    found = links()
    changes = LinkChanges(found.values())
    wrong = LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=0,
        number=1,
        source="",
        target="",
        settings=settings,
    )
    with pytest.raises(MessageError) as refused:
        changes.apply(wrong)
    assert refused.value.reason == "out_of_range"
    changes.apply(change(1, 3, loss=0.4))
    assert losses(found, 3) == [0.4, 0.4, 0.0]


def test_changes_come_in_order() -> None:
    """A change is refused before those with lower numbers.

    Receivers would otherwise disagree about the links.
    """
    found = links()
    changes = LinkChanges(found.values())
    with pytest.raises(MessageError) as caught:
        changes.check(change(2, 0, loss=0.2))
    changes.apply(change(2, 0, loss=0.2))
    assert caught.value.reason == "future"
    assert losses(found, 0) == [0.0, 0.0, 0.0]
