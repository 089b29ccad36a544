"""The channel against ns-3: committed numbers of `make radio`, for the same sends.

Of the cases of more than four stations each fourth one; `make radio` compares all.
"""

import pytest

from benchmarks.radio import model
from benchmarks.radio.cases import Case, cases
from benchmarks.radio.results import differences, numbers, read

REFERENCE = read()
MOST_QUICK = 4  # stations of a case that takes a fraction of a second
LARGE = [case for case in cases() if len(case.positions) > MOST_QUICK]


def parameter(case: Case) -> object:
    """Return a case as a parameter; those of large teams take seconds."""
    return pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case in LARGE else [])


@pytest.mark.parametrize(
    "case", [parameter(case) for case in cases() if case not in LARGE or case in LARGE[::4]]
)
def test_deliveries_and_delays_are_those_of_ns3(case: Case) -> None:
    """Delivered share within 3 points, p50 and p99 of the delay within 10 % or 0.2 ms."""
    assert differences(numbers(case, model.run(case)), REFERENCE[case.name]) == []


def test_every_case_has_a_reference() -> None:
    """The committed numbers are those of the cases as they are."""
    assert list(REFERENCE) == [case.name for case in cases()]
