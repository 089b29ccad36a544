"""The ablation: every part on its own, no duplicates, and a figure with a row for each variant."""

from pathlib import Path

import pytest

from protocol.scenario.file import find_scenario, read_scenario
from tests.support.results import here
from tests.support.runs import ticks
from transport.experiments.ablation import AS_IT_IS, PARTS, ablation
from transport.experiments.cases import cases_of
from transport.experiments.experiment import Experiment
from transport.experiments.network_sweeps import NETWORKS

NAMES = ("paper", "resilient")
OFF = "controller.preview=false"


def built(*settings: str) -> Experiment:
    """Return the ablation of both scenarios."""
    return ablation({name: read_scenario(find_scenario(name), list(settings)) for name in NAMES})


@pytest.mark.slow
def test_one_part_at_a_time() -> None:
    """A variant differs from the scenario as it is in one setting, on the same network; no two runs are equal."""
    experiment = built()
    cases = cases_of(experiment.points, [], 1)
    assert len({case.key for case in cases}) == len(cases) == len(experiment.points)
    trees = {}
    for case in cases:
        point = experiment.points[case.point]
        trees[point.scenario, point.labels["network"], point.labels["part"], point.labels["value"]] = (
            case.scenario.tree()
        )
    for (scenario, network, part, value), tree in trees.items():
        own = trees[scenario, network, AS_IT_IS, ""]
        differing = {
            f"{section}.{key}"
            for section in ("controller", "clock", "links")
            for key in own[section].keys() | tree[section].keys()
            if own[section].get(key) != tree[section].get(key)
        }
        assert differing == (set() if part == AS_IT_IS else {PARTS[str(part)][0]}), (scenario, network, part, value)


def variants(name: str, *settings: str) -> dict[str, list[set[str]]]:
    """Return the values of each part, for each network."""
    points = [point for point in built(*settings).points if point.scenario == name]
    return {
        part: [
            {str(p.labels["value"]) for p in points if (p.labels["network"], p.labels["part"]) == (network, part)}
            for network in NETWORKS
        ]
        for part in PARTS
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_part_has_every_value(name: str) -> None:
    """The value that a scenario has is its row as it is; all the others are there, on every network.

    A preview needs closed-loop prediction or the Riccati cost-to-go: `paper` has neither.
    """
    for part, flown in variants(name).items():
        refused = {"true"} if (name, part) == ("paper", "preview") else set()
        for values in flown:
            assert len(set(PARTS[part][1]) - values - refused) == 1, part


def test_terminal_cost_and_preview_are_parts() -> None:
    """`resilient` varies the multiple of Q with preview and the cost-to-go without it; `paper` the cost-to-go."""
    resilient, paper = variants("resilient"), variants("paper")
    assert (resilient["terminal"][0], resilient["preview"][0]) == ({"multiple"}, {"false"})
    assert (paper["terminal"][0], paper["preview"][0]) == ({"riccati"}, set())


def test_settings_that_contradict_each_other_are_left_out() -> None:
    """A preview without closed loop needs the cost-to-go, the cost-to-go a penalty on the deviation from hover."""
    open_loop = variants("resilient", "controller.prediction=open_loop", "controller.terminal=riccati")
    assert open_loop["terminal"] == [set(), set()]
    absolute = variants("paper", "controller.weights.penalised_input=absolute", "controller.terminal=multiple", OFF)
    assert absolute["terminal"] == [set(), set()]


def test_what_a_setting_gives_is_not_flown_twice() -> None:
    """Settings of all runs define the scenario as it is."""
    points = built(
        "controller.negotiation_iterations=2", "clock.actuation=next_tick", "controller.relaxation=auto"
    ).points
    flown = {(point.labels["part"], point.labels["value"]) for point in points}
    assert ("negotiation iterations", "2") not in flown
    assert ("negotiation iterations", "1") in flown
    assert ("actuation", "next_tick") not in flown
    assert ("actuation", "immediate") in flown
    assert ("relaxation", "0.25") not in flown


def test_what_is_compared_to() -> None:
    """One baseline for each scenario: as it is, on a perfect network."""
    baselines = [point for point in built().points if point.baseline]
    assert [(point.scenario, point.labels["network"]) for point in baselines] == [(name, "perfect") for name in NAMES]


@pytest.mark.slow
def test_the_whole_command(tmp_path: Path) -> None:
    """Table, conclusions and a figure with a row for each variant; no text is cut off."""
    out = tmp_path / "out"
    result = here(
        "experiment",
        "ablation",
        "--scenario",
        "resilient",
        "--seeds",
        "1",
        "--out",
        out,
        "--set",
        ticks(4),
        "--jobs",
        "1",
    )
    assert result.exit_code == 0, result.output
    assert {"points.csv", "cases.csv", "figure.png", "figure.svg"} <= {path.name for path in out.iterdir()}
    for part, (_, values) in PARTS.items():
        assert part in result.stdout
        assert sum(value in result.stdout for value in values) >= len(values) - 1, part
    drawn = (out / "figure.svg").read_text()
    assert "received states: as received" in drawn
    assert "200 ms delay, 30 % loss" in drawn
