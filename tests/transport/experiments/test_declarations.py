"""Declared experiments.

Points that can be simulated, impairments with the stated statistics, refused options.
"""

import csv
import math
import re
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import runs
from tests.support.logs import log_of
from tests.support.results import here
from tests.support.runs import ticks
from transport.cli.commands.experiment import EXPERIMENTS
from transport.experiments import information_experiment, weather_experiment
from transport.experiments.cases import ExperimentError, Point, cases_of
from transport.experiments.declaration import Experiment
from transport.experiments.figures.axes_and_units import axis
from transport.experiments.information_experiment import away
from transport.experiments.network_experiments import JITTER, NETWORKS
from transport.log.run_log import RunLog
from transport.model import state
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup

TICKS = 3_000
BOTH = ("paper", "resilient")


def scenarios(*names: str, settings: tuple[str, ...] = ()) -> dict[str, Scenario]:
    """Return scenarios by name."""
    return {name: read_scenario(find_scenario(name), settings) for name in names}


def built(name: str, *, of: tuple[str, ...] = BOTH, **given: Any) -> Experiment:
    """Return an experiment with some options, as its command builds it."""
    return EXPERIMENTS[name].experiment(scenarios(*of), given)


def delays(point: Point) -> list[list[float]]:
    """Return the delays of many plans on a link of a point."""
    scenario = read_scenario(find_scenario(point.scenario), point.settings)
    path = Link(scenario.links, "agent1", "agent2", seed=0, period_s=0.05)
    return [path.delays(tick) for tick in range(TICKS)]


@pytest.mark.parametrize(("duration_s", "is_long"), [(5.0, False), (5.05, True)])
def test_weather_has_rows_of_silences_that_begin(duration_s: float, *, is_long: bool) -> None:
    """The first silence begins after 5 s: a shorter run would be one on a perfect network."""
    phase = f"maneuver.phase=[{{name='hover',duration_s={duration_s},displacement_m=[0,0,0]}}]"
    flown = scenarios("precise", settings=(phase,))
    points = EXPERIMENTS["weather"].experiment(flown, {}).points
    networks = {point.labels["network"] for point in points}
    assert ("5 s of 10 silent" in networks) is is_long


def test_one_cell_of_the_weather() -> None:
    """One network and one weather give the one point that all of them have for these, its settings too."""
    flown = scenarios("precise")
    everything = EXPERIMENTS["weather"].experiment(flown, {}).points
    cell = {"weather": "gusts 2 m/s", "network": "200 ms, 30 % loss"}
    chosen = {"air": [cell["weather"]], "network": [cell["network"]]}
    (point,) = EXPERIMENTS["weather"].experiment(flown, chosen).points
    assert point.labels == cell
    (same,) = [one for one in everything if one.labels == cell]
    assert point.settings == same.settings
    assert len(everything) == 25


def test_a_scenario_without_a_network_to_choose_keeps_its_own() -> None:
    """UAVs alone have a row also where another network is chosen for the others."""
    experiment = EXPERIMENTS["weather"].experiment(scenarios("alone"), {"network": ["perfect"]})
    assert {point.labels["network"] for point in experiment.points} == {"none"}


@pytest.mark.parametrize(
    "name",
    ["latency", "loss", "jitter", "kill", "matrix", "horizon", "deaths", "sharing"],
)
def test_every_point_is_valid(name: str) -> None:
    """All points are valid scenarios with distinct fingerprints.

    Each scenario, and network, has one baseline.
    """
    flown = {"loss": BOTH, "jitter": ("paper",), "matrix": ("paper",), "horizon": ("paper",)}.get(
        name, ("resilient",)
    )
    experiment = built(name, of=flown, **({"count": 4} if name == "deaths" else {}))
    cases = cases_of(experiment.points, [], 2)
    assert len({case.key for case in cases}) == len(cases)
    networks = list(NETWORKS) if name == "sharing" else [""]
    baselines = [(point.scenario, point.group) for point in experiment.points if point.baseline]
    assert baselines == [(scenario, network) for scenario in flown for network in networks]
    assert len({tuple(point.labels) for point in experiment.points}) == 1
    assert {experiment.x} <= set(experiment.points[0].labels)
    repetitions = [sum(case.point == i for case in cases) for i in range(len(experiment.points))]
    assert set(repetitions) <= {1, 2}


def test_targets_that_one_agent_knows() -> None:
    """All rules of a silence have the same instants, one for each seed; a stop has these rows, and 90 % loss."""
    flown = scenarios("precise", settings=(EXPERIMENTS["information"].maneuver,))
    points = EXPERIMENTS["information"].experiment(flown, {}).points
    silent = [point for point in points if point.labels["network"] == "5 s, own sensors"]
    assert len(silent) == 5
    assert len({point.by_seed for point in silent}) == 1
    with_silences = {point.labels["network"] for point in points if point.by_seed}
    with_stops = {
        point.labels["network"] for point in points if "stop" in str(point.labels["rule"])
    }
    assert with_stops == {*with_silences, "90 % loss"}

    # Without noise of sensors a third of the ten instants suffice.
    quiet = [point for point in points if point.labels["network"] == "2 s of silence"]
    (cut,) = {len(point.by_seed) for point in quiet}
    assert cut == 4
    for point, silent_s in ((quiet[0], 2.0), (silent[0], 5.0)):
        cuts = point.read([EXPERIMENTS["information"].maneuver], 1).links.partition
        assert [one.between for one in cuts] == [["agent1"], ["agent2"], ["agent3"]]
        assert [one.end_s - one.start_s for one in cuts] == pytest.approx([silent_s] * 3)

    cases = cases_of(silent[1:2], [EXPERIMENTS["information"].maneuver], 3)
    starts_s = [case.scenario.links.partition[0].start_s for case in cases]
    assert 1.0 < min(starts_s) < 1.5  # from the first target on,
    assert 9.0 < max(starts_s) < 10.0  # to the last one
    assert len(set(starts_s)) == len(cases) == 10
    assert [target.to for target in cases[0].scenario.maneuver.target] == [[1]] * 4


def information(*, network: str) -> list[Point]:
    """Return the points of all rules on a network."""
    return list(built("information", of=("precise",), network=[network]).points)


def test_the_payload_is_compared_with_that_of_the_run_in_which_all_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Root mean square of the distances, by every rule; a target that not all agents know has no time.

    That run is simulated once where it is not known, as in another process; a run that ended early has no distance.
    """
    maneuver = EXPERIMENTS["information"].maneuver
    told, *others = (
        Setup.of(point.read([maneuver]), "precise") for point in information(network="90 % loss")
    )
    simulated: list[Setup] = []

    def simulate(setup: Setup) -> RunLog:
        simulated.append(setup)
        return log(0.0, 0.0)

    monkeypatch.setattr(information_experiment, "_NEWEST", {})
    monkeypatch.setattr(information_experiment, "run_in_memory", simulate)

    def log(*offsets_m: float) -> RunLog:
        states = [runs.plant_state(told, k) for k in range(len(offsets_m))]
        for one, offset_m in zip(states, offsets_m, strict=True):
            one.x[state.R0] += [0.6 * offset_m, 0.0, 0.8 * offset_m]
        return log_of(states)

    known = {"targets": [{"known_s": 1.5}, {"known_s": 0.5}]}
    assert away(told, known, log(0.0, 0.0)) == {"away_rms_m": 0.0, "known_s": 1.5}
    unknown = {"targets": [{"known_s": 1.5}, {"known_s": None}]}
    assert len(others) == 4
    for other in others:
        found = away(other, unknown, log(1.0, 7.0))
        assert found == {"away_rms_m": pytest.approx(5.0), "known_s": None}
    assert away(others[0], {"targets": []}, log(1.0)) == {"away_rms_m": None, "known_s": None}
    assert simulated == []

    information_experiment._NEWEST.clear()
    for other in others:
        assert away(other, known, log(3.0, 4.0))["away_rms_m"] == pytest.approx(math.sqrt(12.5))
    (again,) = simulated
    assert again.scenario == told.scenario
    for number in range(20):
        information_experiment._keep(str(number), np.zeros((1, 3)))
    assert list(information_experiment._NEWEST) == [str(number) for number in range(6, 20)]


def test_a_rule_sets_what_its_name_says() -> None:
    """Which agents are told, when targets are followed, and what a silence does; the baseline is that all are told.

    After the longest silence there is time for the way to the last target.
    """
    found = {}
    for point in information(network="10 s of silence"):
        rule = point.labels["rule"]
        scenario = point.read([EXPERIMENTS["information"].maneuver], 1)
        controller = scenario.controller
        (to,) = {tuple(target.to) for target in scenario.maneuver.target}
        found[rule] = (to, controller.targets, controller.silence)
        assert (point.baseline, point.group) == (rule == "all told", "10 s of silence")
        (silent,) = {(cut.start_s, cut.end_s) for cut in scenario.links.partition}
        assert silent[1] + 9.0 < scenario.maneuver.phase[0].duration_s
    assert found == {
        "all told": ((), "eager", "alone"),
        "eager": ((1,), "eager", "alone"),
        "confirmed": ((1,), "confirmed", "alone"),
        "stop": ((1,), "eager", "stop"),
        "confirmed, stop": ((1,), "confirmed", "stop"),
    }


@pytest.mark.parametrize(
    ("name", "of", "given", "texts"),
    [
        ("latency", "paper", {"delay": [0.1]}, ["0 ms", "100 ms"]),
        ("loss", "paper", {"loss": [0.0, 0.3]}, ["no loss", "30 % at random", "30 % in bursts"]),
        (
            *("jitter", "paper", {"distribution": ["uniform"], "std": [0.0, 0.05], "mean": 0.16}),
            ["no delay", "constant 160 ms", "uniform with 50 ms"],
        ),
        ("jitter", "paper", {"distribution": ["normal"], "std": [0.0], "mean": 0.0}, ["no delay"]),
        (
            *("matrix", "paper", {"delay": [0.1], "loss": [0.3]}),
            [f"{delay} and {loss} loss" for delay in ("0 ms", "100 ms") for loss in ("0 %", "30 %")],
        ),
        (
            *("sharing", "resilient", {"threshold": [0.01]}),
            [f"{text}, {network}" for network in NETWORKS for text in ("all plans sent", "threshold 0.01")],
        ),
        ("hover", "paper", {"duration": [7.0]}, ["7 s of hover"]),
        ("deaths", "resilient", {"count": 1}, ["no agent killed", "agent3 killed at 21.25 s"]),
        ("scaling", "", {"max": 2}, ["2 UAVs distributed", "2 UAVs centralized"]),
        ("agile", "eight", {"speed": [3.0]}, ["centralized, 3 m/s", "perfect network, 3 m/s"]),
        ("follow", "precise", {"age": [0.2]}, ["constant delay, 0.05 s", "random loss, 0.05 s"]),
        ("information", "precise", {"network": ["perfect"]}, ["all told, perfect", "eager, perfect"]),
    ],
)  # fmt: skip
def test_a_point_is_told_by_its_values(
    name: str, of: str, given: Mapping[str, Any], texts: list[str]
) -> None:
    """The first points, which progress and sentences name; none of a loss or deviation of zero but the baseline."""
    points = built(name, of=(of,) if of else (), **given).points
    told = [point.text for point in points]
    assert told[: len(texts)] == texts
    if name in ("latency", "loss", "jitter", "matrix", "sharing"):
        assert len(told) == len(texts)


def test_the_largest_values_of_an_option_are_allowed() -> None:
    """Bursts in every good tick, a deviation whose delays begin at zero, a death at every tick; no size twice."""
    bursts = built("loss", of=("paper",), loss=[5.0 / 6.0], burst=5.0).points[-1].read()
    assert bursts.links.gilbert_elliott is not None
    assert bursts.links.gilbert_elliott.enter == 1.0
    largest_s = 0.16 / math.sqrt(3.0)
    links = (
        built("jitter", of=("paper",), distribution=["uniform"], std=[largest_s], mean=0.16)
        .points[-1]
        .read()
        .links
    )
    assert links.jitter_s == pytest.approx(2.0 * links.delay_s)
    teams = EXPERIMENTS["scaling"].experiment({}, {"max": 4}).points
    assert [
        point.labels["uavs"] for point in teams if point.labels["ownership"] == "distributed"
    ] == [2, 3, 4]


def test_teams_of_all_sizes_fly_ten_seconds_at_half_a_meter_per_second() -> None:
    """The paper's speed; the largest team is of the experiment's own scenario."""
    (point,) = EXPERIMENTS["scaling"].experiment({}, {"max": 2, "sizes": [2]}).points[:1]
    assert point.scenario == "resilient"
    hover, *ways = point.read([EXPERIMENTS["scaling"].maneuver]).maneuver.phase
    assert [np.linalg.norm(way.displacement_m) / way.duration_s for way in ways] == [0.5, 0.5]
    assert sum(phase.duration_s for phase in (hover, *ways)) == 10.0


@pytest.mark.parametrize(
    ("column", "title", "text"),
    [
        ("delay_s", "delay of plans (ms)", "delay of plans 200 ms"),
        ("links.loss", "loss of plans (%)", "loss of plans 20 %"),
        # Those of the plant have the labels of the agents' links, which name plans.
        (
            "links.measurement.delay_s",
            "links measurement delay (s)",
            "links measurement delay 0.2 s",
        ),
        ("links.actuation.loss", "links actuation loss", "links actuation loss 0.2"),
        (
            "plant.noise.velocity_mps",
            "noise of payload velocity (mm/s)",
            "noise of payload velocity 200 mm/s",
        ),
        ("std_s", *(f"standard deviation of the delay {end}" for end in ("(ms)", "200 ms"))),
        ("speed_mps", "largest speed (m/s)", "largest speed 0.2 m/s"),
    ],
)
def test_a_column_is_named_in_the_unit_of_figures(column: str, title: str, text: str) -> None:
    """Keys of the scenario by their labels, columns of experiments by their own; others in the words of the key."""
    assert (axis(column).title, axis(column).text(0.2)) == (title, text)


def test_options_are_given_in_any_order_and_have_defaults_of_a_trial() -> None:
    """Values of a list are sorted, each once; those of `--quick` are the defaults of a trial alone."""
    declared = EXPERIMENTS["loss"]

    def shares(*, quick: bool = False, **given: Any) -> list[str | float]:
        points = declared.experiment(scenarios("paper"), given, quick=quick).points
        return [point.labels["loss"] for point in points if point.labels["model"] == "bernoulli"]

    assert shares(loss=[0.3, 0.1, 0.3]) == [0.1, 0.3]
    assert shares(loss=[0.2], quick=True) == [0.2]
    assert shares(loss=[]) == shares() == [0.1, 0.3, 0.6]
    assert shares(quick=True) == [0.3]


def test_an_ablation_changes_one_part_at_a_time() -> None:
    """Values that the scenario has anyway are left out, and those that its other settings exclude."""
    points = built("ablation", of=("paper",)).points
    networks = [point.labels["network"] for point in points if point.labels["part"] == "as it is"]
    assert networks == list(NETWORKS)
    changes = {(point.labels["part"], point.labels["value"]) for point in points}
    assert {("prediction", "closed_loop"), ("actuation", "next_tick")} < changes
    assert not {("prediction", "open_loop"), ("relaxation", "1.0")} & changes
    assert ("preview", "true") not in changes  # needs the shared control law or a cost-to-go


def test_scaling_has_teams_of_all_sizes_and_pairs_of_even_ones() -> None:
    """A team of two in a pair is the centralized one; the largest is always there."""
    points = EXPERIMENTS["scaling"].experiment({}, {"max": 5}).points
    teams = [(point.labels["ownership"], point.team, point.labels["agents"]) for point in points]
    assert teams == [
        *(("distributed", (uavs, 1), uavs) for uavs in (2, 3, 4, 5)),
        ("pairs", (4, 2), 2),
        *(("centralized", (uavs, uavs), 1) for uavs in (2, 3, 4, 5)),
    ]
    assert {point.labels["ownership"] for point in points if point.baseline} == {"centralized"}
    assert all(point.group == f"{point.labels['uavs']} UAVs" for point in points)


def test_each_agent_is_killed_with_and_without_a_restart() -> None:
    """At the times asked for, one agent in each run, which the others survive."""
    points = built("kill", of=("paper",), at=2.0, restart=3.5).points
    faults = []
    for point in points[1:]:
        scenario = point.read()
        assert scenario.clock.on_agent_loss == "continue"
        faults.append([(one.do, one.at_s, one.target) for one in scenario.faults.event])
    killed = [[("kill", 2.0, f"agent{agent}")] for agent in (1, 2, 3, 4)]
    restarted = [[*one, ("restart", 3.5, one[0][2])] for one in killed]
    assert faults == [*restarted, *killed]


def mean_age_s(point: Point) -> float:
    """Return the mean age of the newest plan of another agent over many ticks, s."""
    arrived: dict[int, int] = {}  # by tick, the newest plan that arrives
    for tick, sent in enumerate(delays(point)):
        for delay_s in sent:
            # A plan of a tick counts from the next one on at the earliest.
            at_tick = tick + max(1, math.ceil(delay_s / 0.05 - 1e-9))
            arrived[at_tick] = max(tick, arrived.get(at_tick, 0))
    newest, ages = 0, []
    for tick in range(TICKS):
        newest = max(newest, arrived.get(tick, 0))
        ages.append(tick - newest)
    return 0.05 * float(np.mean(ages[TICKS // 10 :]))


def test_information_about_the_platform_has_the_age_of_its_column() -> None:
    """A delay and a loss of one column give plans of the same mean age; without messages no plan arrives."""
    points = built("follow", of=("precise",), age=[0.2, 0.5]).points
    assert [point.labels["age_s"] for point in points] == [0.05] * 3 + [0.2] * 3 + [0.5] * 3
    for point in points:
        if point.labels["network"] == "no messages":
            assert not any(delays(point))
        else:
            assert mean_age_s(point) == pytest.approx(point.labels["age_s"], rel=0.15)
        # Nothing is random there.
        assert (point.by_seed == ((),)) == (point.labels["network"] == "no messages")
    assert [point.labels for point in points if point.baseline] == [
        {"network": "constant delay", "age_s": 0.05}
    ]


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_losses_are_comparable(share: float) -> None:
    """Independent and bursty losses have the same share in the long run.

    Bursts last as long as asked for.
    """
    _, independent, bursts = built("loss", of=("paper",), loss=[share], burst=5.0).points
    for point, correlated in ((independent, 1.0), (bursts, 10.0)):
        lost = np.array([not found for found in delays(point)])
        deviation = math.sqrt(share * (1.0 - share) * correlated / TICKS)
        assert abs(lost.mean() - share) < 4.0 * deviation
    ends = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    lengths = ends[1::2] - ends[::2]
    model = read_scenario(find_scenario("paper"), bursts.settings).links.gilbert_elliott
    assert model is not None
    assert 1.0 / model.leave == pytest.approx(5.0)
    # A geometric length of mean 5 has a standard deviation of 4.5.
    assert abs(lengths.mean() - 5.0) < 4.0 * 4.5 / math.sqrt(len(lengths))


def test_a_loss_of_the_scenario_is_left_out() -> None:
    """Every point has the loss that it names, and no other."""
    bursts = "links.gilbert_elliott={enter=0.2,leave=0.2}"
    both = scenarios("paper", settings=("links.loss=0.3", bursts))
    experiment = EXPERIMENTS["loss"].experiment(both, {"loss": [0.1], "burst": 5.0})
    for point, share in zip(experiment.points, [0.0, 0.1, 0.1], strict=True):
        settings = ["links.loss=0.3", bursts, *point.settings]
        scenario = read_scenario(find_scenario("paper"), settings)
        path = Link(scenario.links, "agent1", "agent2", seed=0, period_s=0.05)
        lost = np.array([not path.delays(tick) for tick in range(TICKS)])
        deviation = math.sqrt(share * (1.0 - share) * 10.0 / TICKS)
        assert abs(lost.mean() - share) <= 4.0 * deviation


@pytest.mark.parametrize(
    ("name", "options", "losses"),
    [
        ("matrix", {"delay": [0.1], "loss": [0.4]}, [0.0, 0.4, 0.0, 0.4]),
        ("sharing", {"threshold": [0.1]}, [0.0, 0.0, 0.3, 0.3]),
    ],
)
def test_bursts_and_jitter_of_the_scenario_are_left_out(
    name: str, options: Mapping[str, Any], losses: list[float]
) -> None:
    """Losses are independent and of the named share; delays are constant."""
    own = ("links.gilbert_elliott={enter=0.2,leave=0.2}", "links.jitter_s=0.05", "links.loss=0.2")
    points = EXPERIMENTS[name].experiment(scenarios("resilient", settings=own), options).points
    links = [point.read(own).links for point in points]
    assert [one.loss for one in links] == losses
    for one in links:
        assert one.jitter_s == 0.0
        assert one.gilbert_elliott is None or one.gilbert_elliott.enter == 0.0


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("latency", {"delay": [0.0]}),
        ("jitter", {"distribution": ["uniform"], "std": [0.04], "mean": 0.16}),
        ("matrix", {"delay": [0.0], "loss": [0.0]}),
        ("sharing", {"threshold": [0.0], "heartbeat": 1.0}),
    ],
)
@pytest.mark.parametrize(
    "own", ["links.jitter_s=0.05", "links={distribution='empirical',samples_s=[0.05,0.1]}"]
)
def test_a_jitter_of_the_scenario_is_left_out(
    name: str, options: Mapping[str, Any], own: str
) -> None:
    """The point without delay has none."""
    points = EXPERIMENTS[name].experiment(scenarios("resilient", settings=(own,)), options).points
    scenario = read_scenario(find_scenario("resilient"), [own, *points[0].settings])
    path = Link(scenario.links, "agent1", "agent2", seed=0, period_s=0.05)
    assert {delay for tick in range(TICKS) for delay in path.delays(tick)} == {0.0}


@pytest.mark.parametrize(
    ("name", "options"), [("latency", {"delay": [0.1]}), ("loss", {"loss": [0.1], "burst": 5.0})]
)
def test_recorded_links_are_refused(name: str, options: Mapping[str, Any]) -> None:
    """A recording has delays and losses of its own, which no setting takes away."""
    recorded = scenarios("resilient", settings=("links.trace=[[0.0,0.05],[1.0,0.1]]",))
    with pytest.raises(ExperimentError, match=r"links\.trace: expected none.*got 2 rows"):
        EXPERIMENTS[name].experiment(recorded, options)


def test_each_threshold_is_one_point() -> None:
    """All plans are sent at a threshold of zero, as in the baseline: once."""
    given = {"threshold": [0.0, 0.01, 0.01], "heartbeat": 0.5}
    points = built("sharing", of=("resilient",), **given).points
    assert points[1].read().controller.share_heartbeat_s == 0.5
    assert [point.labels["share_threshold"] for point in points] == [0.0, 0.01] * len(NETWORKS)


@pytest.mark.parametrize("distribution", list(JITTER))
def test_jitters_are_comparable(distribution: str) -> None:
    """Every distribution has the mean and the standard deviation asked for, beside a constant delay with that mean."""
    perfect, constant, point = built(
        "jitter", of=("paper",), distribution=[distribution], std=[0.04], mean=0.16
    ).points
    assert (delays(perfect)[0], delays(constant)[0]) == ([0.0], [0.16])
    assert [one.labels["mean_s"] for one in (perfect, constant, point)] == [0.0, 0.16, 0.16]
    found_s = np.array([delay for found in delays(point) for delay in found])
    assert len(found_s) == TICKS
    assert abs(found_s.mean() - 0.16) < 4.0 * 0.04 / math.sqrt(TICKS)
    # Four standard deviations of it: by the kurtosis, at most 9 but for the lognormal distribution
    # with its 114.
    kurtosis = 114.0 if distribution == "lognormal" else 9.0
    assert abs(found_s.std() - 0.04) < 4.0 * 0.04 * math.sqrt((kurtosis - 1.0) / (4.0 * TICKS))


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("latency", {"delay": [math.nan]}, "links.delay_s=nan: expected"),
    (
        "loss",
        {"loss": [1.0]},
        "--loss: expected at most 0.833 with bursts of 5 ticks on average, got 1",
    ),
    (
        "loss",
        {"loss": [0.9], "burst": 2.0},
        "--loss: expected at most 0.667 with bursts of 2 ticks on average, got 0.9",
    ),
    ("weather", {"network": ["good"]}, "--network: expected one of perfect; 200 ms, 30 % loss; "),
    ("weather", {"air": ["storm"]}, "--air: expected one of still air, gusts 1 m/s, "),
    ("jitter", {"distribution": ["cauchy"]}, "--distribution: expected one of uniform, normal,"),
    (
        "jitter",
        {"distribution": ["uniform"], "std": [0.1]},
        "--std: expected a standard deviation from 0 to 0.0924 s (uniform, mean 0.16 s), got 0.1",
    ),
    ("matrix", {"loss": [1.5]}, "links.loss=1.5: expected"),
    ("sharing", {"heartbeat": 0.0}, "controller.share_heartbeat_s=0.0: expected"),
    (
        "loss",
        {"loss": [0.3], "burst": math.inf},
        "--burst: expected a finite number of ticks, got inf",
    ),
    ("kill", {"at": 8.0, "restart": 8.0}, "--restart: expected a time after --at 8 s, got 8"),
    (
        "kill",
        {"at": 8.0, "restart": math.inf},
        "--restart: expected a time after --at 8 s, got inf",
    ),
    ("horizon", {"horizon": [0]}, "controller.horizon=0: expected"),
    (
        "follow",
        {"age": [0.04]},
        "--age: expected at least a sampling period, 0.05 s, got 0.04",
    ),
    ("information", {"rule": ["bold"]}, "--rule: expected one of all told; eager; "),
    ("information", {"network": ["good"]}, "--network: expected one of perfect; 200 ms; 500 ms; "),
    ("hover", {"duration": [math.nan]}, "duration_s=nan: expected"),
]


@pytest.mark.parametrize(
    ("name", "given", "expected"), REFUSED, ids=[expected for *_, expected in REFUSED]
)
def test_bad_values_are_refused(name: str, given: dict[str, Any], expected: str) -> None:
    """A value that cannot be is refused with option, expected and got."""
    with pytest.raises((ExperimentError, ScenarioError)) as refusal:
        cases_of(built(name, **given).points, (), 1)
    assert expected in str(refusal.value)


def test_sharing_on_the_command_line(tmp_path: Path) -> None:
    """The table has the share of plans sent, which falls with the threshold.

    The figure a curve for each network.
    """
    arguments = (
        "--threshold",
        "1000",
        "--heartbeat",
        "0.2",
        "--seeds",
        "1",
        "--jobs",
        "1",
        "--set",
        ticks(9),
    )
    result = here("experiment", "sharing", *arguments, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "sent (%)" in result.stdout.partition("\n\n")[0]
    with (tmp_path / "points.csv").open(encoding="utf-8", newline="") as file:
        shares = [float(row["plans_shared_share"]) for row in csv.DictReader(file)]
    assert shares == pytest.approx([1.0, 3 / 9, 1.0, 3 / 9])  # ticks 0, 4 and 8
    drawn = (tmp_path / "figure.svg").read_text()
    assert "plans sent (%)" in drawn
    assert all(network in drawn for network in NETWORKS)


def test_agile_flies_every_case_at_every_speed() -> None:
    """Each speed is set where the maneuver has one, and each has a baseline of its own.

    The fastest is feasible.
    """
    experiment = built("agile", of=("eight",))
    speeds = {point.labels["speed_mps"] for point in experiment.points}
    assert speeds == {3.0, 4.0, 5.0, 6.0}
    assert len(experiment.points) == len(speeds) * len(
        {point.labels["case"] for point in experiment.points}
    )
    assert [point.group for point in experiment.points if point.baseline] == [
        f"{speed:g} m/s" for speed in sorted(speeds)
    ]
    (case,) = cases_of([point for point in experiment.points if point.baseline][-1:], (), 1)
    assert case.scenario.maneuver.phase[1].speed_mps == 6.0
    with pytest.raises(
        ExperimentError, match="expected a maneuver with speed_mps in a phase, got resilient"
    ):
        built("agile", of=("resilient",))


def named_impairments(name: str) -> tuple[float, float]:
    """Return the delay, s, and the loss that the name of a network tells."""
    delay = re.search(r"(?:^|, )([\d.]+) (ms|s)(?=$|,| delay)", name)
    loss = re.search(r"([\d.]+) % loss", name)
    scale = 1e-3 if delay and delay[2] == "ms" else 1.0
    return (
        scale * float(delay[1]) if delay and "own sensors" not in name else 0.0,
        float(loss[1]) / 100.0 if loss else 0.0,
    )


NAMED = {
    **NETWORKS,
    **weather_experiment.NETWORKS,
    **information_experiment.NETWORKS,
    "none": ("links.loss=1.0",),
}


@pytest.mark.parametrize("name", [name for name in NAMED if name != "none"])
def test_a_network_has_the_delay_and_the_loss_of_its_name(name: str) -> None:
    """Also a radio its rate and offsets; sensors of its own and gusts are told, and nothing else is set."""
    scenario = scenarios("precise", settings=NAMED[name])["precise"]
    links = scenario.links
    assert (links.delay_s, links.loss) == pytest.approx(named_impairments(name))
    radio = scenario.radio
    assert (radio is not None) == ("radio" in name)
    if radio is not None:
        offsets = {"slots": "slots", "no slots": "none"}[name.partition(", ")[2]]
        assert (f"radio {radio.rate_mbps:g} Mb/s" in name, radio.offsets) == (True, offsets)
        # Free space at 1 m, and an exponent above that of free space, 2, as in the experiment with the radio.
        assert (radio.path_loss_1m_db, radio.path_loss_exponent) == (46.7, 3.0)
    if "own sensors" in name:
        assert scenario.plant.sensors == "vehicle"
        assert scenario.controller.disturbance.estimate
    assert set(scenario.plant.wind.gust_mps) == ({1.0} if "gusts" in name else {0.0})


def test_each_case_of_agile_changes_what_its_name_says() -> None:
    """Network, payload, motors, wind, drag and agents; forces are estimated where they are unknown."""
    found = {}
    for point in built("agile", of=("eight",), speed=[3.0]).points:
        s = point.read()
        found[point.labels["case"]] = (
            *(s.links.delay_s, s.links.loss, s.plant.payload_mass_factor, s.plant.motors.lag_s),
            *(
                s.plant.wind.speed_mps[0],
                s.controller.disturbance.estimate,
                s.controller.knows_drag,
            ),
            *(len(s.owned), s.controller.relaxation),
        )
    late, three = (0.2, 0.3), (3, 0.5)
    assert found == {
        "centralized": (0.0, 0.0, 1.0, 0.03, 0.0, False, True, 1, 1.0),
        "perfect network": (0.0, 0.0, 1.0, 0.03, 0.0, False, True, *three),
        "200 ms delay, 30 % loss": (*late, 1.0, 0.03, 0.0, False, True, *three),
        "400 ms delay, 30 % loss": (0.4, 0.3, 1.0, 0.03, 0.0, False, True, *three),
        "payload -43 %": (*late, 0.57, 0.03, 0.0, True, True, *three),
        "payload -20 %": (*late, 0.8, 0.03, 0.0, True, True, *three),
        "payload +20 %": (*late, 1.2, 0.03, 0.0, True, True, *three),
        "payload +43 %": (*late, 1.43, 0.03, 0.0, True, True, *three),
        "motor lag 60 ms": (*late, 1.0, 0.06, 0.0, False, True, *three),
        "wind 5 m/s": (*late, 1.0, 0.03, 5.0, True, True, *three),
        "unknown drag": (*late, 1.0, 0.03, 0.0, True, False, *three),
    }


def test_every_horizon_has_every_terminal_weight_on_both_networks() -> None:
    """The scenario's own are always there, and the baseline; a cost-to-go takes the place of weights."""
    points = built(
        "horizon", of=("paper", "resilient"), horizon=[5], terminal=[2.0], delay=0.3
    ).points
    found = set()
    for point in points:
        scenario = point.read()
        labels = point.labels
        controller = scenario.controller
        ends = {"cost-to-go", controller.weights.terminal}
        assert labels["terminal"] in ends
        assert scenario.links.delay_s == (0.0 if labels["network"] == "perfect" else 0.3)
        assert labels["horizon"] == controller.horizon
        found.add((point.scenario, *labels.values()))
    networks = ("perfect", "300 ms delay")
    assert found == {
        *product(["paper"], networks, [5, 20], [2.0, 5.0]),
        *product(["resilient"], networks, [5, 20], ["cost-to-go"]),
    }
    assert [(one.scenario, *one.labels.values()) for one in points if one.baseline] == [
        ("paper", "perfect", 20, 5.0),
        ("resilient", "perfect", 20, "cost-to-go"),
    ]
    texts = {one.labels["terminal"]: one.text for one in points if one.labels["horizon"] == 5}
    assert texts == {
        2.0: "N_p 5, terminal weight 2, 300 ms delay",
        5.0: "N_p 5, terminal weight 5, 300 ms delay",
        "cost-to-go": "N_p 5, cost-to-go, 300 ms delay",
    }


def test_a_long_hover_is_that_of_the_last_phase() -> None:
    """The phases before it stay, and no run is a baseline; a last phase with a speed has no duration to set."""
    points = built("hover", of=("paper",), duration=[7.0, 65.0]).points
    usual_s = [phase.duration_s for phase in scenarios("paper")["paper"].maneuver.phase]
    for point, hover_s in zip(points, (7.0, 65.0), strict=True):
        lasting_s = [phase.duration_s for phase in point.read().maneuver.phase]
        assert lasting_s == [*usual_s[:-1], hover_s]
        assert (point.labels, point.baseline) == ({"hover_s": hover_s}, False)

    fast = "maneuver.phase=[{name='go',kind='spline',points_m=[[6,0,0]],speed_mps=0.8,ramp_s=2.0}]"
    with pytest.raises(ExperimentError, match="whose last phase has a duration, not a speed"):
        EXPERIMENTS["hover"].experiment(scenarios("paper", settings=(fast,)), {})


def test_deaths_are_at_random_ticks_of_random_agents() -> None:
    """One death for good in each run, in the order of time, the same for the same seed; at most one at a tick."""

    def deaths(count: int, draw: int, *settings: str) -> list[tuple[float, str]]:
        flown = scenarios("resilient", settings=settings)
        perfect, *points = (
            EXPERIMENTS["deaths"].experiment(flown, {"count": count, "draw": draw}).points
        )
        assert (perfect.baseline, dict(perfect.labels)) == (
            True,
            {"agent": "none", "killed_s": 0.0},
        )
        killed = []
        for point in points:
            scenario = point.read(settings)
            (event,) = scenario.faults.event
            assert (event.do, scenario.clock.on_agent_loss) == ("kill", "continue")
            assert event.target == f"agent{point.labels['agent']}"
            assert event.at_s == point.labels["killed_s"]
            killed.append((event.at_s, event.target))
        return killed

    killed = deaths(40, 3)
    times_s = np.array([at_s for at_s, _ in killed])
    assert len(killed) == 40
    assert (np.diff(times_s) > 0.0).all()
    assert 0.0 <= times_s[0] < 5.0
    assert 20.0 < times_s[-1] < 25.0
    assert times_s / 0.05 == pytest.approx(np.round(times_s / 0.05))
    assert {target for _, target in killed} == {"agent1", "agent2", "agent3", "agent4"}
    assert killed == deaths(40, 3) != deaths(40, 4)
    assert [at_s for at_s, _ in deaths(40, 3, ticks(4))] == pytest.approx([0.0, 0.05, 0.1, 0.15])


COMMON = {
    "negotiation iterations": ["2", "4"],
    "received states": ["as_received"],
    "actuation": ["next_tick"],
    "discretisation": ["euler"],
}
ABLATED = {
    "paper": {
        "prediction": ["closed_loop"],
        "terminal": ["riccati"],
        "relaxation": ["0.5", "0.25", "0.1"],
        "received plans": ["by_age", "held"],
        **COMMON,
    },
    "resilient": {
        "prediction": ["open_loop"],
        "terminal": ["multiple"],
        "preview": ["false"],
        "relaxation": ["1.0", "0.25", "0.1"],
        "received plans": ["by_one", "held"],
        **COMMON,
    },
}


def test_an_ablation_has_all_values_that_change_a_scenario() -> None:
    """Those of `paper` and `resilient`, each alone, on both networks; the baseline is the unchanged one."""
    points = built("ablation").points
    changes: dict[str, dict[str, list[str]]] = {}
    for point in points:
        part, value = str(point.labels["part"]), str(point.labels["value"])
        if point.labels["network"] == "perfect" and value:
            changes.setdefault(point.scenario, {}).setdefault(part, []).append(value)
    assert changes == ABLATED
    assert [(one.scenario, *one.labels.values()) for one in points if one.baseline] == [
        (name, "perfect", "as it is", "") for name in BOTH
    ]


def test_the_kill_of_an_agent_is_told_with_its_return() -> None:
    """By agent and by when it is back; the baseline has no kill."""
    none, *points = built("kill", of=("paper",), at=2.0, restart=3.5).points
    assert (none.baseline, none.labels, none.read().faults.event) == (
        True, {"agent": "none", "restart_s": "none"}, [],
    )  # fmt: skip
    told = [(*point.labels.values(), point.text) for point in points]
    assert told == [
        *((f"{k}", 3.5, f"agent{k} restarted after 1.5 s") for k in (1, 2, 3, 4)),
        *((f"{k}", "never", f"agent{k} not restarted") for k in (1, 2, 3, 4)),
    ]


TITLES = {
    "std_s": ("standard deviation of the delay (ms)", 1e3),
    "agent": ("agent killed", 1.0),
    "network": ("network", 1.0),
    "restart_s": ("restart (s)", 1.0),
    "killed_s": ("time at which the agent is killed (s)", 1.0),
    "hover_s": ("duration of the last hover (s)", 1.0),
    "speed_mps": ("largest speed (m/s)", 1.0),
    "uavs": ("number of UAVs", 1.0),
    "age_s": ("mean age of the newest plan (s)", 1.0),
    "terminal": ("terminal weight", 1.0),
    "share_threshold": ("threshold (% of the input's range; 0: all plans sent)", 100.0),
    "rule": ("rule of the agents that learn a target from plans", 1.0),
    "cost_mean": ("mean cost ($10^{-3}$)", 1e3),
    "away_rms_m": ("away, rms (cm)", 100.0),
    "delay_s": ("delay of plans (ms)", 1e3),
    "loss": ("loss of plans (%)", 100.0),
}


@pytest.mark.parametrize("column", TITLES)
def test_a_column_of_an_experiment_has_a_title_and_a_unit(column: str) -> None:
    """Numbers in the figure are those of the column times the factor to the unit."""
    found = axis(column)
    assert (found.title, found.factor) == TITLES[column]
