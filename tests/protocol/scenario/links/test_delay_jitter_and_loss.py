"""Links: each impairment has the statistics of its definition, and depends on nothing but the message."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.runs import setup
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.links.link_changes import link_change
from transport.protocol.scenario.scenario_file import ScenarioError, validate
from transport.protocol.scenario.sections.link_sections import (
    GilbertElliottSection,
    LinkChangeSection,
    LinkSection,
    LinksSection,
    PartitionSection,
)
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.scenario.setup.run_setup import Setup

PERIOD_S = 0.05
COUNT = 5_000
# Bounds of all statistical tests: five standard errors, one false alarm in two million at fixed
# seeds.
SIGMAS = 5.0


# Measured delays, by the name of their file.
SAMPLES = [0.01, 0.02, 0.02, 0.5]


def link(
    section: LinkSection,
    seed: int = 0,
    sender: str = "agent1",
    receiver: str = "agent2",
    partition: list[PartitionSection] | None = None,
) -> Link:
    """A link that carries plans."""
    links = LinksSection(**dict(section), partition=partition or [])
    return Link(links, sender, receiver, seed=seed, period_s=PERIOD_S)


def link_history(section: LinkSection, seed: int = 0) -> list[list[float]]:
    """Delays of many messages."""
    one = link(section, seed)
    return [one.delays(tick) for tick in range(COUNT)]


def share(happened: list[bool], expected: float) -> None:
    """Check a share against a probability, for independent events."""
    error = np.sqrt(expected * (1.0 - expected) / len(happened))
    assert abs(np.mean(happened) - expected) < SIGMAS * error


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.6])
def test_bernoulli_loss(loss: float) -> None:
    """The share of lost messages is the probability, and one loss says nothing about the next."""
    lost = [not delays for delays in link_history(LinkSection(loss=loss))]
    share(lost, loss)
    share([b for a, b in pairwise(lost) if a], loss)


def test_bursts_of_gilbert_elliott() -> None:
    """Share of time in the bad state is enter / (enter + leave), and a burst lasts 1 / leave ticks on average."""
    enter, leave = 0.05, 0.25
    lost = np.array(
        [
            not delays
            for delays in link_history(
                LinkSection(gilbert_elliott=GilbertElliottSection(enter=enter, leave=leave))
            )
        ]
    )
    bad = enter / (enter + leave)
    # Neighbours are correlated by 1 - enter - leave, which widens the error of the mean.
    correlation = 1.0 - enter - leave
    error = np.sqrt(bad * (1.0 - bad) / COUNT * (1.0 + correlation) / (1.0 - correlation))
    assert abs(lost.mean() - bad) < SIGMAS * error
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]])))
    lengths = edges[1::2] - edges[::2]
    assert abs(lengths.mean() - 1.0 / leave) < SIGMAS * lengths.std() / np.sqrt(len(lengths))


def test_bursts_and_other_losses_are_independent() -> None:
    """A message arrives if neither takes it: in the bad state a share of them is lost as well."""
    # The next state does not depend on the state: bad with probability `enter`.
    bursts = GilbertElliottSection(enter=0.3, leave=0.7, loss=0.5)
    lost = [not delays for delays in link_history(LinkSection(loss=0.3, gilbert_elliott=bursts))]
    share(lost, 1.0 - (1.0 - 0.3) * (1.0 - 0.3 * 0.5))


@pytest.mark.parametrize(
    ("distribution", "mean_s", "deviation_s"),
    [
        ("uniform", 1.0, 0.05 / np.sqrt(12.0)),
        ("normal", 1.0, 0.05),
        ("exponential", 1.05, 0.05),
        ("lognormal", 1.0 + 0.05 / np.sqrt(math.e - 1.0), 0.05),
    ],
)
def test_jitter(distribution: Any, mean_s: float, deviation_s: float) -> None:
    """Mean and standard deviation of the delay are those of the distribution about the fixed delay."""
    model = LinkSection(delay_s=1.0, jitter_s=0.05, distribution=distribution)
    delays = np.array([delay for fate in link_history(model) for delay in fate])
    fourth = np.mean((delays - delays.mean()) ** 4) / delays.var() ** 2
    assert abs(delays.mean() - mean_s) < SIGMAS * deviation_s / np.sqrt(COUNT)
    assert abs(delays.std() / deviation_s - 1.0) < SIGMAS * np.sqrt((fourth - 1.0) / 4.0 / COUNT)


def test_delays_below_zero_become_zero() -> None:
    """Jitter about a delay of zero is half the time none."""
    delays_s = [fate[0] for fate in link_history(LinkSection(jitter_s=0.1))]
    assert min(delays_s) == 0.0
    share([delay_s == 0.0 for delay_s in delays_s], 0.5)


def test_empirical_delays_are_drawn_evenly() -> None:
    """Each measured delay is as likely as the others, and nothing else is drawn."""
    delays = [
        delays[0]
        for delays in link_history(LinkSection(distribution="empirical", samples_s=SAMPLES))
    ]
    assert set(delays) == set(SAMPLES)
    share([delay == 0.02 for delay in delays], 0.5)
    share([delay == 0.5 for delay in delays], 0.25)


def test_duplicates_have_delays_of_their_own() -> None:
    """The share that arrives twice is the probability; the second delay is drawn anew."""
    found = link_history(LinkSection(delay_s=0.1, jitter_s=0.1, duplicate=0.2))
    share([len(fate) == 2 for fate in found], 0.2)
    twice = np.array([fate for fate in found if len(fate) == 2])
    assert abs(np.corrcoef(twice.T)[0, 1]) < SIGMAS / np.sqrt(len(twice))


def test_reordering_holds_back() -> None:
    """A share of the messages comes later by a fixed time, behind those sent after them."""
    found = [
        delays[0] for delays in link_history(LinkSection(delay_s=0.02, reorder=0.1, reorder_s=0.2))
    ]
    assert set(found) == {0.02, 0.02 + 0.2}
    share([delay > 0.1 for delay in found], 0.1)


def test_partition_has_a_start_and_an_end() -> None:
    """No message sent in [start, end) arrives; those sent before and after do."""
    one = link(
        LinkSection(), partition=[PartitionSection(between=["agent1"], start_s=0.5, end_s=1.0)]
    )
    assert [bool(one.delays(tick)) for tick in (9, 10, 19, 20)] == [True, False, False, True]
    assert [one.usable_ticks(tick) for tick in (9, 10)] == [[10], []]


@pytest.mark.parametrize("rate_hz", [0.5, 3.0, 7.0, 10.0, 15.0, 19.9])
def test_rate_limit(rate_hz: float) -> None:
    """A link of r Hz carries r of 20 messages in every whole second, as evenly spread as ticks allow."""
    carried = np.array([bool(delays) for delays in link_history(LinkSection(rate_hz=rate_hz))])
    assert carried[0]
    at = np.flatnonzero(carried)
    # Seconds since the first message times the rate, rounded: at most one message from a steady
    # flow at any instant.
    assert np.abs(np.cumsum(carried) - 1.0 - np.arange(COUNT) * PERIOD_S * rate_hz).max() <= 1.0
    apart = 1.0 / (PERIOD_S * rate_hz)
    assert set(np.diff(at)) <= {int(np.floor(apart)), int(np.ceil(apart))}


def test_rounding_delays_no_message_of_a_limited_rate() -> None:
    """At 5.6 Hz the message of tick 25 is the seventh after the first, though 25 (5.6 0.05) < 7 in floats."""
    one = link(LinkSection(rate_hz=5.6))
    assert [bool(one.delays(tick)) for tick in (24, 25, 26)] == [False, True, False]


@pytest.mark.parametrize(
    ("delay_s", "ticks"),
    [(0.0, 1), (0.03, 1), (0.05, 1), (0.051, 2), (0.1, 2), (0.15, 3), (0.4, 8)],
)
def test_virtual_arrival(delay_s: float, ticks: int) -> None:
    """A message is usable at the first tick later than its own at or after its arrival.

    Source: docs/time.md.
    """
    one = link(LinkSection(delay_s=delay_s))
    assert one.usable_ticks(7) == [7 + ticks]
    assert one.usable_ticks(7, after=2) == [7 + max(ticks, 2)]
    # On the air and on the link 0.1 s + 0.2 s > 0.3 s in floats, which costs no tick.
    assert link(LinkSection(delay_s=0.2)).usable_ticks(0, air_s=0.1) == [6]
    on_air = link(LinkSection())
    assert on_air.usable_ticks(7, air_s=delay_s) == [7 + ticks]


def test_negotiations_are_independent() -> None:
    """Plans exchanged within one tick are lost independently of each other and of the tick's last one."""
    one = link(LinkSection(loss=0.5))
    lost = np.array(
        [[not one.delays(tick, negotiation) for tick in range(2000)] for negotiation in range(4)]
    )
    correlations = np.corrcoef(lost)[np.triu_indices(4, 1)]
    assert np.abs(correlations).max() < SIGMAS / np.sqrt(2000)


def test_the_order_of_questions_does_not_matter() -> None:
    """The delays of a message do not depend on the order in which they are computed, bursts included."""
    bursts = GilbertElliottSection(enter=0.1, leave=0.3)
    model = LinkSection(
        delay_s=0.1,
        jitter_s=0.1,
        loss=0.2,
        gilbert_elliott=bursts,
        duplicate=0.2,
        reorder=0.2,
        reorder_s=0.1,
    )
    ticks = np.random.default_rng(0).permutation(500)
    shuffled = {int(tick): one.delays(int(tick)) for one in [link(model)] for tick in ticks}
    in_order = link(model)
    assert all(in_order.delays(tick) == shuffled[tick] for tick in range(500))


def test_links_and_seeds_are_independent() -> None:
    """Another seed, sender or receiver gives an independent sequence of delays."""
    model = LinkSection(loss=0.5)
    variants = [
        link(model),
        link(model, seed=1),
        link(model, sender="agent3"),
        link(model, receiver="agent3"),
    ]
    lost = np.array(
        [[not one.delays(tick) for tick in range(2000)] for one in variants], dtype=float
    )
    correlations = np.corrcoef(lost)[np.triu_indices(len(variants), 1)]
    assert np.abs(correlations).max() < SIGMAS / np.sqrt(2000)


ENDS = (
    ("agent1", "agent2"),
    ("agent2", "agent1"),
    ("plant", "agent1"),
    ("plant", "agent2"),
    ("agent1", "plant"),
)


def delays_ms(*settings: str, tick: int = 0) -> list[int]:
    """The fixed delays of some links of a scenario, in the order of `ENDS`."""
    run = setup(*settings)
    return [round(1e3 * run.rules.link(*ends).impairments(tick).delay_s) for ends in ENDS]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((), [0, 0, 0, 0, 0]),
        (("links.delay_s=0.1",), [100, 100, 0, 0, 0]),
        (("links.measurement.delay_s=0.1",), [0, 0, 100, 100, 0]),
        (("links.actuation.delay_s=0.1",), [0, 0, 0, 0, 100]),
        # An override concerns the plant only by name.
        (("links.override=[{delay_s=0.1}]",), [100, 100, 0, 0, 0]),
        (("links.override=[{from='agent1',delay_s=0.1}]",), [100, 0, 0, 0, 0]),
        (("links.override=[{to='agent1',delay_s=0.1}]",), [0, 100, 0, 0, 0]),
        (("links.override=[{from='plant',delay_s=0.1}]",), [0, 0, 100, 100, 0]),
        (("links.override=[{from='plant',to='agent2',delay_s=0.1}]",), [0, 0, 0, 100, 0]),
        (("links.override=[{to='plant',delay_s=0.1}]",), [0, 0, 0, 0, 100]),
        # It replaces what is said of all such links, and the last one counts.
        (
            (
                "links.measurement={delay_s=0.1}",
                "links.override=[{from='plant',to='agent1',loss=0.5}]",
            ),
            [0, 0, 0, 100, 0],
        ),
        (
            ("links.override=[{from='agent1',delay_s=0.1},{to='agent2',delay_s=0.2}]",),
            [200, 0, 0, 0, 0],
        ),
    ],
)
def test_which_links_a_section_is_for(settings: tuple[str, ...], expected: list[int]) -> None:
    """Plans, measurements and actuation have a section each.

    An override applies to the links of its ends.
    """
    assert delays_ms(*settings) == expected


def test_partition_with_the_plant() -> None:
    """A partition cuts links between its members and the rest; the plant's only if it is named."""

    def cut(between: str) -> list[bool]:
        run = setup(f"links.partition=[{{between={between},start_s=0.0,end_s=1.0}}]")
        return [not run.rules.link(*ends).delays(0) for ends in ENDS]

    assert cut("['agent1']") == [True, True, False, False, False]
    assert cut("['plant']") == [False, False, True, True, True]
    assert cut("['agent1','plant']") == [True, True, False, True, False]
    assert cut("['agent1','agent2']") == [False, False, False, False, False]


def test_scripted_change() -> None:
    """From its instant on a change applies to the links it names.

    Keys that it does not give stay as they are.
    """
    settings = (
        "links={delay_s=0.1,loss=0.25}",
        "links.change=[{at_s=0.5,delay_s=0.2},{at_s=1.0,to='agent1',loss=0.5},{at_s=0.75,from='plant',delay_s=0.3}]",
    )
    assert [delays_ms(*settings, tick=tick) for tick in (9, 10, 14, 15, 100)] == [
        [100, 100, 0, 0, 0],
        [200, 200, 0, 0, 0],
        [200, 200, 0, 0, 0],
        [200, 200, 300, 300, 0],
        [200, 200, 300, 300, 0],
    ]
    one = setup(*settings).rules.link("agent2", "agent1")
    assert [one.impairments(tick).loss for tick in (0, 19, 20)] == [0.25, 0.25, 0.5]


def test_the_later_one_of_two_changes_is_in_force() -> None:
    """In any order in the file, within one sampling period, and where one by hand comes before a scripted one."""
    both = "links.change=[{at_s=0.99,delay_s=0.2,loss=0.5},{at_s=0.96,delay_s=0.1}]"
    one = setup(both).rules.link("agent1", "agent2")
    assert one.impairments(20).delay_s == 0.2
    by_hand = LinkChangeSection.model_validate({"at_s": 0.0, "delay_s": 0.3})
    one.change(10, by_hand)
    found = [
        (one.impairments(tick).delay_s, one.impairments(tick).loss) for tick in (9, 10, 19, 20)
    ]
    assert found == [(0.0, 0.0), (0.3, 0.0), (0.3, 0.0), (0.2, 0.5)]


def test_a_change_does_not_rewrite_the_past() -> None:
    """Delays of messages sent before a change are those of a link that never changes, bursts included."""
    bursts = "links={loss=0.1,gilbert_elliott={enter=0.1,leave=0.2}}"
    before = setup(bursts).rules.link("agent1", "agent2")
    after = setup(
        bursts, "links.change=[{at_s=10.0,gilbert_elliott={enter=0.5,leave=0.1}}]"
    ).rules.link("agent1", "agent2")
    delays_before, delays_after = (
        [one.delays(tick) for tick in reversed(range(400))][::-1] for one in (before, after)
    )
    assert delays_before[:200] == delays_after[:200]
    assert sum(map(bool, delays_after[200:])) < sum(map(bool, delays_before[200:])) - 50


def test_measured_delays_come_from_a_file(tmp_path: Path) -> None:
    """A file of delays is read relative to the scenario.

    Garbage in it is refused with the file and the number.
    """
    scenario = setup().scenario
    (tmp_path / "delays.csv").write_text("0.01, 0.02\n0.03\n")
    source = str(tmp_path / "scenario.toml")
    tree = scenario.tree()
    tree["links"] = {"distribution": "empirical", "samples_s": "delays.csv"}
    built = Setup.of(validate(tree, source), source)
    delays = {
        delay for tick in range(100) for delay in built.rules.link("agent1", "agent2").delays(tick)
    }
    assert delays == {0.01, 0.02, 0.03}
    for content in ("0.01 fast", "", "-0.1", "inf"):
        (tmp_path / "delays.csv").write_text(content)
        with pytest.raises(ScenarioError, match=r"links: samples_s|links\.samples_s"):
            Setup.of(validate(tree, source), source)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("0,045\n0,051\n", r"row 1: expected .* with a decimal point.*, got '0,045'"),
        ("0.045\n0,051, 0,060\n", r"row 2: expected .* with a decimal point.*, got '0,051'"),
        ("1,2,3", "row 1: expected .* with a decimal point"),
        ("1,5e-3", "row 1: expected .* with a decimal point.*, got '1,5e-3'"),
        ("0.1\n0.2 nan", "row 2: expected a finite number, got 'nan'"),
        ("0.1; 0.2", "row 1: expected a finite number, got '0.1;'"),
        ("0.1 1_0", "row 1: expected a finite number, got '1_0'"),
        ("0.1 " + 99 * "x", f"row 1: expected a finite number, got '{60 * 'x'}'$"),
        ("0.1\n50\n483.2", r"at most 10, got 483\.2; divide milliseconds by 1000; if seconds"),
    ],
)
def test_delays_of_doubtful_numbers_are_refused(content: str, problem: str, tmp_path: Path) -> None:
    """Decimal commas, and delays whose magnitude is that of milliseconds, are not taken for seconds."""
    (tmp_path / "delays.csv").write_text(content, encoding="utf-8")
    tree = setup().scenario.tree()
    tree["links"] = {"distribution": "empirical", "samples_s": "delays.csv"}
    with pytest.raises(ScenarioError, match=problem):
        validate(tree, str(tmp_path / "scenario.toml"))


def test_long_delays_that_are_meant_are_taken(tmp_path: Path) -> None:
    """With `longest_sample_s` delays may be as long, in a file, a list and for a single link."""
    (tmp_path / "delays.csv").write_text("0.5\n483.2", encoding="utf-8")
    tree = setup().scenario.tree()
    meant = {"distribution": "empirical", "longest_sample_s": 500.0}
    tree["links"] = {
        **meant,
        "samples_s": "delays.csv",
        "override": [{"to": "agent1", **meant, "samples_s": [500.0]}],
    }
    links = validate(tree, str(tmp_path / "scenario.toml")).links
    assert (links.samples_s, links.override[0].samples_s) == ([0.5, 483.2], [500.0])


def test_the_old_name_of_the_delays_tells_the_new_one() -> None:
    """The key has its unit in its name; the one without is refused with the new one, also in a change of links."""
    tree = setup().scenario.tree()
    tree["links"] = {"distribution": "empirical", "samples": [0.1]}
    with pytest.raises(ScenarioError, match=r"links\.samples: unknown key; it is now 'samples_s'"):
        validate(tree, "scenario.toml")
    with pytest.raises(RequestError, match="samples: unknown key; it is now 'samples_s'"):
        link_change("", "", '{"samples": [0.1]}')


def test_a_link_has_two_ends() -> None:
    """A link from a process to itself does not exist, in a scenario and in a request."""
    with pytest.raises(RequestError, match="to: expected another process than the sender, got 'a"):
        link_change("agent1", "agent1", '{"loss": 0.1}')
    for key in ("override=[{", "change=[{at_s=1,"):
        with pytest.raises(ScenarioError, match="to: expected another process than the sender"):
            setup(f"links.{key}from='agent2',to='agent2',loss=0.1}}]")
