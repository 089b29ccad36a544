"""Measured tables of each page, which `make figures` renews.

The modules `measured_*.py` have first the runs of their tables as settings of ready scenarios, then the tables. A
table stands in its page between the markers of its name, and `docs/table_rows_and_cells.py` has its parts:

    Run       a scenario, its settings, the number of UAVs and of seeds
    cell      a number of the summary, its format, and a factor to the unit shown (m to cm: 100)
    listed    a table with a run in each row, and a number in each column
    grid      a table with a run in each cell

To add a row, add a run; `make figures TABLES=name` simulates what has no kept result.
"""

from measured_controllers import ENGINES, SCENARIO, TIME, VALUES
from measured_guarantees import GUARANTEES
from measured_results import RADIO, RESULTS

PAGES = {
    "record/guarantees.md": GUARANTEES,
    "record/engines.md": ENGINES,
    "record/values.md": VALUES,
    "record/measured.md": (*SCENARIO, *TIME),
    "record/results.md": RESULTS,
    "record/radio.md": RADIO,
}
