"""What one agent knows: targets told to agent 1, by the rule of the others and by the network.

Far targets that the others follow by some rule, and a platform that moves on while information about it ages.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from transport.experiments.arena.arena_tasks_and_networks import TASKS
from transport.experiments.cases import Point, check_names, key_of, refused
from transport.experiments.declaration import Values, declared
from transport.experiments.simulation import run_in_memory
from transport.experiments.weather_experiment import FORCES, SENSORS, WEATHER
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.state import R0
from transport.protocol.scenario.scenario_file import with_settings
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import given_values
from transport.protocol.wire.messages import PlantState

# Four targets, 2 to 4 m apart, one every 3 s, in a run that is long enough for 10 s of silence and the way after it.
_HOVER = "maneuver.phase=[{name='hover',duration_s=30.0,displacement_m=[0,0,0]}]"
_TARGETS = ((1.0, "2,0,-10"), (4.0, "2,3,-10"), (7.0, "-1,2,-11"), (10.0, "0,0,-10"))

_CONFIRMED, _STOP = "controller.targets=confirmed", "controller.silence=stop"
ALL = "all told"
# Settings of each rule; but for the first one the targets are told to agent 1.
RULES: Mapping[str, tuple[str, ...]] = {
    ALL: (),
    "eager": (),
    "confirmed": (_CONFIRMED,),
    "stop": (_STOP,),
    "confirmed, stop": (_CONFIRMED, _STOP),
}
_RADIO = "radio={{rate_mbps=6.0,offsets='{}',path_loss_exponent=3.0,path_loss_1m_db=46.7}}"
NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": (),
    "200 ms": ("links.delay_s=0.2",),
    "500 ms": ("links.delay_s=0.5",),
    "1 s": ("links.delay_s=1.0",),
    "30 % loss": ("links.loss=0.3",),
    "90 % loss": ("links.loss=0.9",),
    "200 ms, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
    "radio 6 Mb/s, slots": (_RADIO.format("slots"),),
    "radio 6 Mb/s, no slots": (_RADIO.format("none"),),
    "2 s of silence": (),
    "5 s of silence": (),
    "10 s of silence": (),
    "5 s, own sensors": (*SENSORS, FORCES),
    "5 s, own sensors, gusts": (*SENSORS, FORCES, *WEATHER["gusts 1 m/s"]),
}
# Lengths of silences, s: from a random instant between two targets on.
_SILENT_S = {
    name: float(name.split()[0]) for name in list(NETWORKS) if "silence" in name or "own" in name
}
# Where information gets as old as in silence: elsewhere a stop in silence changes no bit of a run.
_STOPS = {*_SILENT_S, "90 % loss"}


def away(setup: Setup, summary: Any, log: RunLog) -> Mapping[str, float | None]:
    """Return how far the payload is from that of the run in which all are told at once, rms, m.

    And the longest time until all agents know a target, s: none if they never do.
    """
    payload_I = _payload(log)
    told_I = _all_told(setup, payload_I)
    rms_m = None
    if payload_I.shape == told_I.shape:
        rms_m = float(np.sqrt(((payload_I - told_I) ** 2).sum(axis=1).mean()))
    known_s = [target["known_s"] for target in summary["targets"]]
    longest_s = None if None in known_s else max(known_s, default=None)
    return {"away_rms_m": rms_m, "known_s": longest_s}


# Payload of the newest runs in which all are told, by fingerprint: the runs of the other rules follow.
_NEWEST: dict[str, Array] = {}
_MOST_NEWEST = len(NETWORKS)


def _all_told(setup: Setup, payload_I: Array) -> Array:
    """Return the payload of the run in which all are told, which is simulated where it is not this one."""
    scenario = setup.scenario
    settings = [_targets(""), "controller.targets=eager", "controller.silence=alone"]
    told = with_settings(given_values(scenario), settings, scenario.name, allow_large=True)
    key = key_of(told)
    if key == key_of(scenario):
        _keep(key, payload_I)
    elif key not in _NEWEST:
        _keep(key, _payload(run_in_memory(Setup.of(told, told.name))))
    return _NEWEST[key]


def _keep(key: str, payload_I: Array) -> None:
    if len(_NEWEST) == _MOST_NEWEST:
        _NEWEST.pop(next(iter(_NEWEST)))
    _NEWEST[key] = payload_I


def _payload(log: RunLog) -> Array:
    """Return the positions of the payload, (k, 3), m."""
    return np.array([one.x[R0] for one in log.of(PlantState)])


@declared(
    "rule",
    y="network",
    shown="away_rms_m",
    more=away,
    scenarios=("precise",),
    seeds=3,
    maneuver=_HOVER,
    quick_maneuver=_HOVER,
    rule=Values(list(RULES), "NAME", "Rules.", quick=[ALL, "eager", "confirmed"]),
    network=Values(list(NETWORKS), "NAME", "Networks.", quick=["perfect", "200 ms"]),
    instants=Values(
        10, "COUNT", "Instants of silences with own sensors; a third without.", 2, least=1
    ),
)
def information(
    scenario: Scenario, rule: Sequence[str], network: Sequence[str], instants: int
) -> Iterator[Point]:
    """Targets that one agent knows.

    Four targets are told to agent 1, and the others learn them from plans: followed at once (eager),
    once all are known to have them (confirmed), and with a stop in silence. Networks with delay, loss, a
    shared radio and silences, each compared with the run in which all agents are told. The rules with a
    stop are run in silence and with 90 % loss: elsewhere they change nothing.

    Example: transport experiment information --scenario precise --network "5 s of silence"
    """
    check_names("--rule", rule, RULES)
    check_names("--network", network, NETWORKS)
    for name in (name for name in NETWORKS if name in network):
        for way in (way for way in RULES if way in rule):
            if _STOP in RULES[way] and name not in _STOPS:
                continue
            to = "" if way == ALL else ",to=[1]"
            yield Point(
                {"network": name, "rule": way},
                f"{way}, {name}",
                (_targets(to), *NETWORKS[name], *RULES[way]),
                baseline=way == ALL,
                group=name,
                by_seed=_silences(scenario, name, instants),
            )


def _targets(to: str) -> str:
    """Return the setting of the targets, told to some agents."""
    entries = [f"{{at_s={at_s},points_m=[[{place}]]{to}}}" for at_s, place in _TARGETS]
    return f"maneuver.target=[{','.join(entries)}]"


def _silences(scenario: Scenario, network: str, instants: int) -> tuple[tuple[str, ...], ...]:
    """Return for each seed a silence of all agents from a random instant between two targets on.

    Without noise of sensors a third of the instants suffice.
    """
    silent_s = _SILENT_S.get(network)
    if silent_s is None:
        return ()
    is_noisy = NETWORKS[network][: len(SENSORS)] == SENSORS
    count = instants if is_noisy else math.ceil(instants / 3)
    rng = np.random.default_rng(0)
    others = range(1, len(scenario.owned))  # all but one: that one hears no agent either
    first_s, last_s = _TARGETS[0][0], _TARGETS[-1][0]
    settings = []
    for start_s in rng.uniform(first_s, last_s, count):
        times = f"start_s={start_s:.2f},end_s={start_s + silent_s:.2f}"
        cuts = [f"{{between=['agent{agent}'],{times}}}" for agent in others]
        settings.append((f"links.partition=[{','.join(cuts)}]",))
    return tuple(settings)


# Hover and targets of the arena's platform, told to agent 1.
_PLATFORM, _ITS_PLACES = TASKS["follow"].settings
DELAY, LOSS, NO_MESSAGES = "constant delay", "random loss", "no messages"


@declared(
    "age_s",
    curves="network",
    drawn_as="age",
    scenarios=("precise", "resilient"),
    seeds=3,
    maneuver=_PLATFORM,
    quick_maneuver=_PLATFORM,
    age=Values(
        [0.1, 0.2, 0.4, 0.6, 0.8, 1.0],
        "SECONDS",
        "Mean age of the newest plan, s.",
        quick=[0.2],
    ),
)
def follow(scenario: Scenario, age: Sequence[float]) -> Iterator[Point]:
    """Error over the age of information.

    A platform moves at 1 m/s with random turns; its place is told to agent 1 every half second. The others
    learn it from plans, delayed or lost at random, of which the newest has the given age in the mean, or from none.

    Example: transport experiment follow --age 0.2 --age 0.5 --scenario precise
    """
    period_s = scenario.controller.sampling_period_s
    ages_s = sorted({period_s, *age})
    if ages_s[0] < period_s:
        raise refused("--age", f"at least a sampling period, {period_s:g} s", f"{ages_s[0]:g}")

    for age_s in ages_s:
        is_perfect = age_s == period_s
        # The newest plan is a period old at the least; with the loss p it is 1 / (1 - p) periods old in the mean.
        impaired = {
            DELAY: () if is_perfect else (f"links.delay_s={age_s!r}",),
            LOSS: () if is_perfect else (f"links.loss={1.0 - period_s / age_s!r}",),
            NO_MESSAGES: ("links.loss=1.0",),
        }
        for network, settings in impaired.items():
            yield Point(
                {"network": network, "age_s": age_s},
                f"{network}, {age_s:g} s",
                (_ITS_PLACES, *settings),
                baseline=is_perfect and network == DELAY,
                # Without any message there is nothing random.
                by_seed=((),) if network == NO_MESSAGES else (),
            )
