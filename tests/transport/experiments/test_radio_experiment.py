"""The experiment with the radio: teams by rate, offsets, sharing and distance."""

import pytest

from transport.cli.commands.experiment import EXPERIMENTS
from transport.experiments.cases import ExperimentError, Point, cases_of
from transport.experiments.declaration import NONE


def points(**given: object) -> tuple[Point, ...]:
    """Return the points of the experiment with options."""
    return EXPERIMENTS["radio"].experiment({}, given).points


def test_every_team_has_a_baseline_and_its_variants() -> None:
    """Each size is flown without a radio, and with each rate, offset, sharing and distance."""
    found = points(max=4, rate=[6.0, 24.0], offsets=["slots", "none"], distance=[1.0, 20.0])
    assert [point.labels["uavs"] for point in found if point.baseline] == [3, 4]
    assert len(found) == 2 * (1 + 2 * 2 * 2)
    assert {point.team for point in found} == {(3, 1), (4, 1)}
    cases = cases_of(found, [], 1)
    assert len({case.key for case in cases}) == len(found)
    radios = [case.scenario.radio for case in cases]
    assert sum(radio is None for radio in radios) == 2
    assert {point.labels["variant"] for point in found if point.baseline} == {NONE}


def test_distance_is_path_loss() -> None:
    """Ten times the distance is a path loss that is larger by ten times the exponent, in dB."""
    near, far = (
        case.scenario.radio for case in cases_of(points(max=3, distance=[1.0, 10.0]), [], 1)[1:3]
    )
    assert near is not None
    assert far is not None
    assert near.path_loss_1m_db is not None
    assert far.path_loss_1m_db == pytest.approx(
        near.path_loss_1m_db + 10.0 * near.path_loss_exponent
    )


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"rate": [7.0]}, "--rate: expected one of 6, 9, 12, 18, 24, 36, 48, 54, got 7"),
        ({"offsets": ["early"]}, "--offsets: expected one of none, slots, random, got early"),
        ({"sharing": ["never"]}, "--sharing: expected one of always, on_change, got never"),
    ],
)
def test_wrong_options_are_refused(given: dict[str, object], text: str) -> None:
    """An impossible option is refused with what is expected."""
    with pytest.raises(ExperimentError, match=text):
        points(**given)
