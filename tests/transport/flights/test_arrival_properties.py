"""Properties of runs over drawn networks: Hypothesis draws links, deaths, returns and arrival orders."""

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.runs import ready, recorded, reproducible
from tests.support.shuffled import fly_shuffled
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message, Plan, PlantState, Roster, StepReport, Tick

HOVER = "maneuver.phase=[{name='hover',duration_s=0.6,displacement_m=[0,0,0]}]"
AGENTS = (1, 2, 3, 4)
EXAMPLES = 15  # a run of twelve ticks, flown twice, takes 0.1 s
MOST_AGE = 12  # ticks of a run

# Each link: seconds, probabilities. Zero and one included, where all or nothing arrives.
DELAYS = st.sampled_from([0.0, 0.04, 0.05, 0.12])
SHARES = st.sampled_from([0.0, 0.3, 1.0])


@st.composite
def networks(draw: st.DrawFn) -> tuple[str, ...]:
    """Draw impairments of all links, and different ones of a single link."""
    source, target = draw(st.permutations(AGENTS))[:2]
    override = f"from='agent{source}',to='agent{target}',delay_s={draw(DELAYS)},loss={draw(SHARES)}"
    return (
        f"links.delay_s={draw(DELAYS)}",
        f"links.jitter_s={draw(DELAYS)}",
        f"links.loss={draw(SHARES)}",
        f"links.duplicate={draw(SHARES)}",
        f"links.override=[{{{override}}}]",
    )


@st.composite
def deaths(draw: st.DrawFn) -> tuple[str, ...]:
    """Draw an agent that is killed, at any tick, and whether and when it is started again."""
    victim = draw(st.sampled_from(AGENTS))
    death = draw(st.integers(0, 8))
    back = draw(st.none() | st.integers(death + 1, 10))
    events = [f"{{at_s={0.05 * death},do='kill',target='agent{victim}'}}"]
    if back is not None:
        events.append(f"{{at_s={0.05 * back},do='restart',target='agent{victim}'}}")
    return ("clock.on_agent_loss=continue", f"faults.event=[{','.join(events)}]")


def by_kind(messages: Sequence[Message]) -> dict[type[Message], list[bytes]]:
    """Return the reproducible bytes of a run by kind, in the order of sender and sequence."""
    kinds = (Plan, StepReport, PlantState, Tick, Roster)
    ordered = sorted(messages, key=lambda message: (message.sender, message.sequence))
    return {
        kind: [encode(reproducible(message)) for message in ordered if isinstance(message, kind)]
        for kind in kinds
    }


@settings(max_examples=EXAMPLES)
@given(network=networks(), death=st.just(()) | deaths(), order=st.integers(0, 2**32 - 1))
def test_bits_do_not_depend_on_the_order_of_arrival(
    network: tuple[str, ...], death: tuple[str, ...], order: int
) -> None:
    """Whatever the network and the deaths, a random order of arrival gives every message's bits."""
    run = ready("resilient", HOVER, *network, *death)
    straight = recorded(run)
    shuffled = recorded(run, lambda setup, record: fly_shuffled(setup, record, seed=order))
    assert by_kind(shuffled) == by_kind(straight)


@settings(max_examples=EXAMPLES)
@given(network=networks(), death=deaths())
def test_rosters_only_grow_and_name_who_answers(
    network: tuple[str, ...], death: tuple[str, ...]
) -> None:
    """Versions and incarnations of rosters grow, and a tick is answered by members alone."""
    messages = recorded(ready("resilient", HOVER, *network, *death))
    rosters = [message for message in messages if isinstance(message, Roster)]
    versions = [roster.version for roster in rosters]
    assert versions == sorted(set(versions))

    newest = dict.fromkeys(AGENTS, 0)
    for roster in rosters:
        for agent, incarnation in zip(roster.agents, roster.incarnations, strict=True):
            assert incarnation >= newest[agent]
            newest[agent] = incarnation

    members = {roster.version: set(roster.agents) for roster in rosters}
    ticks = [message for message in messages if isinstance(message, Tick)]
    assert [tick.tick for tick in ticks] == list(range(len(ticks)))
    for tick in ticks:
        assert set(tick.answered) <= set(AGENTS)
        assert tick.roster in members


@settings(max_examples=EXAMPLES)
@given(network=networks())
def test_no_plan_is_used_before_it_arrives(network: tuple[str, ...]) -> None:
    """A plan used at tick k is of an earlier tick, and no plan is both lost and delivered."""
    run = ready("resilient", HOVER, *network)
    reports = [message for message in recorded(run) if isinstance(message, StepReport)]
    for report in reports:
        for peer, age in zip(report.peers, report.plan_ages, strict=True):
            delays = run.rules.link(f"agent{peer}", f"agent{report.agent}").delays
            if age < 0:
                continue
            assert 1 <= age <= MOST_AGE
            sent = report.tick - age
            arrivals = [sent * run.period_ns + round(delay * 1e9) for delay in delays(sent)]
            assert min(arrivals) <= report.tick * run.period_ns
