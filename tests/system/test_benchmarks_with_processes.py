"""The benchmark with processes: its table has the documented rows. Times are not judged."""

import pytest

from benchmarks import loop
from benchmarks.effort import QUICK
from tests.support.tables import first_cells, numbers, silent


@pytest.mark.slow
def test_the_loop_has_its_rows() -> None:
    """The table has rows for teams, maneuver and certificates, all with numbers."""
    teams, maneuver, keys = loop.measure(QUICK, silent)
    assert first_cells(teams) == [str(uavs) for uavs in QUICK.processes]
    assert first_cells(maneuver) == ["processes", "in memory"]
    assert first_cells(keys) == ["without certificates", "with certificates"]
    assert all(all(cell != "-" for cell in row) for row in teams.rows)
    assert numbers(teams, "tick, ms")[0] > 0.0
