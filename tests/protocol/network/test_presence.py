"""Presence of a process: its own tokens by the table of its stages, and those of the others."""

from dataclasses import dataclass, field

import pytest

from tests.support.runs import setup, tick
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.network.presence import (
    STAGES,
    OtherPresences,
    OwnPresence,
    PresenceStep,
    Stage,
)
from transport.protocol.network.session import BusError
from transport.protocol.wire.codec import VERSION, encode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Presence

DIGEST = "00000000000000aa"
KEYS = Keys("r")


@dataclass
class Shown:
    """Tokens that the others see, and all that happened to them."""

    now: list[str] = field(default_factory=list)
    story: list[str] = field(default_factory=list)

    def declare(self, key: str) -> "Token":
        """Show a token."""
        self.now.append(key)
        self.story.append(f"+ {KEYS.end(key)}")
        return Token(self, key)


@dataclass
class Token:
    """A token that can be withdrawn."""

    shown: Shown
    key: str

    def undeclare(self) -> None:
        """Withdraw it."""
        self.shown.now.remove(self.key)
        self.shown.story.append(f"- {KEYS.end(self.key)}")


def own() -> tuple[OwnPresence, Shown]:
    """Return an agent that no other knows of yet, and what the others see of it."""
    shown = Shown()
    return OwnPresence("agent2", 3, DIGEST, KEYS, shown.declare), shown


def others() -> OtherPresences:
    """Return what the plant knows of the others, of whom none is up."""
    return OtherPresences("plant", DIGEST, KEYS, Gate("plant", KEYS, setup().rules.shape))


def test_a_new_incarnation_is_there_before_the_old_one_goes() -> None:
    """No moment is without a token of the process: the others never see it gone for good."""
    presence, shown = own()
    presence.announce()
    presence.announce()
    presence.join()
    presence.renew(4)
    assert presence.stage is Stage.RENEWING
    assert presence.incarnation == 3
    presence.begin_anew(4)
    assert presence.incarnation == 4
    alive = f"{DIGEST}/{VERSION}"
    assert shown.story == [
        f"+ alive/agent2/3/{alive}",
        "+ ready/agent2/3",
        f"+ alive/agent2/4/{alive}",
        "+ ready/agent2/4",
        f"- alive/agent2/3/{alive}",
        "- ready/agent2/3",
    ]


def test_a_process_that_leaves_begins_nothing() -> None:
    """A note of a new incarnation that is still in the queue is not followed any more."""
    presence, shown = own()
    presence.announce()
    presence.join()
    presence.renew(4)
    presence.leave()
    before = list(shown.story)
    presence.begin_anew(4)
    assert shown.story == before
    assert presence.incarnation == 3


def test_a_new_incarnation_is_asked_for_once_and_seldom() -> None:
    """Neither for the one that is there or noted, nor within a second of a question without answer."""
    presence, _ = own()
    presence.announce()
    presence.join()
    assert not presence.may_renew(3, 10.0)
    assert presence.may_renew(4, 10.0)
    presence.delay_renewal(10.0)
    assert not presence.may_renew(4, 10.9)
    assert presence.may_renew(4, 11.0)
    presence.renew(4)
    assert not presence.may_renew(4, 11.0)
    assert presence.may_renew(5, 11.0)


def test_of_two_notes_the_newer_one_is_followed() -> None:
    """A process that is removed again before it has read the note of its return begins once."""
    presence, shown = own()
    presence.announce()
    presence.join()
    presence.renew(4)
    presence.renew(5)
    before = list(shown.story)
    presence.begin_anew(4)
    assert shown.story == before
    presence.begin_anew(5)
    assert (presence.incarnation, presence.stage) == (5, Stage.READY)
    assert shown.now == [KEYS.alive("agent2", 5, DIGEST, VERSION), KEYS.ready("agent2", 5)]


@pytest.mark.parametrize("stage", Stage)
def test_each_stage_can_be_left(stage: Stage) -> None:
    """A process may leave at any time, and only once; what is no step of its stage is a defect."""
    if stage is not Stage.LEAVING:
        assert STAGES[stage][PresenceStep.LEAVE] is Stage.LEAVING
    presence, _ = own()
    presence.leave()
    with pytest.raises(RuntimeError, match="agent2 cannot leave while it is leaving"):
        presence.leave()


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
def test_the_end_of_an_old_incarnation_is_not_that_of_a_newer_one(order: tuple[int, int]) -> None:
    """Its token may disappear before or after the newer one appears."""
    plant = others()
    old = KEYS.alive("agent2", 1, DIGEST, VERSION)
    new = KEYS.alive("agent2", 2, DIGEST, VERSION)
    assert plant.take(old, is_there=True) is None
    happens = {1: (old, False), 2: (new, True)}
    events = [plant.take(key, is_there=there) for key, there in (happens[step] for step in order)]
    assert [event for event in events if event] == [Presence("agent2", 1, alive=False)]
    assert plant.alive == {"agent2": 2}
    assert not plant.departed


def test_a_process_that_is_gone_has_left() -> None:
    """It takes part from "ready" on, and is gone with "alive", whichever token disappears first."""
    plant = others()
    alive = KEYS.alive("agent2", 1, DIGEST, VERSION)
    ready = KEYS.ready("agent2", 1)
    assert plant.take(alive, is_there=True) is None
    assert plant.take(ready, is_there=True) == Presence("agent2", 1, alive=True)
    assert plant.take(ready, is_there=False) is None
    assert plant.take(alive, is_there=False) == Presence("agent2", 1, alive=False)
    assert plant.departed == {"agent2"}
    assert plant.alive == {}
    assert plant.take(KEYS.alive("agent2", 2, DIGEST, VERSION), is_there=True) is None
    assert not plant.departed


def test_a_start_that_is_announced_ends_the_messages_of_the_one_before() -> None:
    """The gate learns of it by its token."""
    gate = Gate("plant", KEYS, setup().rules.shape)
    plant = OtherPresences("plant", DIGEST, KEYS, gate)
    plant.take(KEYS.alive("coordinator", 1, DIGEST, VERSION), is_there=True)
    assert list(gate.accept(KEYS.of(tick(0)), encode(tick(0)))) == []
    assert [entry.reason for entry in gate.rejections] == ["wrong_incarnation"]


@pytest.mark.parametrize(
    "key",
    [
        KEYS.alive("agent2", 1, "11111111111111bb", VERSION),
        KEYS.alive("agent2", 1, DIGEST, VERSION + 1),
    ],
)
def test_a_process_of_another_scenario_or_protocol_is_not_up(key: str) -> None:
    """Its tokens, as they appear and disappear, change nothing and are no event."""
    plant = others()
    assert plant.take(KEYS.alive("agent2", 1, DIGEST, VERSION), is_there=True) is None
    assert plant.take(key, is_there=True) is None
    assert plant.take(key, is_there=False) is None
    assert plant.alive == {"agent2": 1}
    assert not plant.departed


def test_a_malformed_token_is_counted_once() -> None:
    """As it appears, not as it disappears."""
    gate = Gate("plant", KEYS, setup().rules.shape)
    plant = OtherPresences("plant", DIGEST, KEYS, gate)
    malformed = KEYS.alive("agent2", 1, DIGEST, VERSION).replace("/1/", "/first/")
    for is_there in (True, False):
        assert plant.take(malformed, is_there=is_there) is None
    assert gate.rejections.total == 1
    assert plant.alive == {}


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (KEYS.alive("plant", 7, DIGEST, VERSION), "plant is already running in this run"),
        (KEYS.alive("agent1", 0, DIGEST, VERSION + 1), "install the same release on all hosts"),
        (KEYS.alive("agent1", 0, "11111111111111bb", VERSION), "agent1 runs another scenario"),
    ],
)
def test_a_process_that_does_not_fit_is_refused(key: str, text: str) -> None:
    """Another of this name, another protocol, another scenario; a token that does not say so is ignored."""
    plant = others()
    with pytest.raises(BusError, match=text):
        plant.check(key, 0)
    fitting = KEYS.alive("plant", 0, DIGEST, VERSION)
    for harmless in (fitting, KEYS.ready("plant", 7), f"{KEYS.prefix}/alive/plant"):
        plant.check(harmless, 0)
