"""Messages of a log that count: those of agents that took part in the tick of the message."""

from msgspec.structs import replace

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message
from tests.support import runs
from tests.support.logs import log_of, plan, report
from transport.analysis.series import counted

HOVER = runs.ticks(10)
ALL = {1: 0, 2: 0, 3: 0, 4: 0}
LEFT = {1: 0, 3: 0, 4: 0}
BACK = {1: 0, 2: 1, 3: 0, 4: 0}


def messages_of(run: Setup) -> list[Message]:
    """Four ticks: agent 2 answers the first, stops in the second, and is back in the fourth as a new incarnation."""
    messages: list[Message] = [runs.roster(ALL)]
    for k, (members, version) in enumerate([(ALL, 1), (ALL, 1), (LEFT, 2), (BACK, 3)]):
        if k == 3:
            messages.append(runs.roster(BACK, k=3, version=3))
        answered = {0: (), 1: tuple(ALL), 2: tuple(LEFT), 3: tuple(LEFT)}[k]
        messages.append(runs.tick(k, answered=answered, members=tuple(members), version=version))
        for agent, incarnation in members.items():
            if not (agent == 2 and k == 1):
                messages += [replace(m, incarnation=incarnation) for m in (plan(run, agent, k), report(run, agent, k))]
        if k == 1:
            messages.append(runs.roster(LEFT, k=1, version=2))
    return messages


def kept(run: Setup, messages: list[Message]) -> list[int]:
    """Return the indices of the messages that count."""
    places = {id(message): place for place, message in enumerate(messages)}
    return [places[id(entry.message)] for entry in counted(run, log_of(messages)).messages]


def stale(run: Setup, k: int, incarnation: int = 0) -> list[Message]:
    """Return the outdated messages that agent 2 sends of a tick when it continues."""
    return [replace(message, incarnation=incarnation) for message in (plan(run, 2, k), report(run, 2, k))]


def test_messages_of_a_continued_process_do_not_count() -> None:
    """Plans and reports of the tick in which it stopped, and later ones of its old incarnation, do not count."""
    run = runs.setup(HOVER)
    flight = messages_of(run)
    for late in (stale(run, 1), stale(run, 2), stale(run, 3), stale(run, 3, incarnation=2)):
        assert kept(run, [*flight, *late]) == list(range(len(flight)))


def test_in_real_time_late_plans_count() -> None:
    """In real time a plan that missed its deadline counts; only its incarnation decides."""
    run = runs.setup(HOVER, "clock.mode=realtime", "clock.speed=1")
    flight = messages_of(run)
    assert kept(run, [*flight, *stale(run, 1)]) == list(range(len(flight) + 2))
    assert kept(run, [*flight, *stale(run, 3)]) == list(range(len(flight)))
