"""Delays of the plans that agents used: column, series and figure."""

import math

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

import transport
from tests.support import runs
from tests.support.log_messages import on_reference, radio_report, report
from tests.support.logs import log_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.plan_delays import first_uses, plan_delays
from transport.analysis.steps import steps_rows
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import LinkChange, StepReport
from transport.report.figures.run_figures import fill
from transport.report.figures.style import RC

PHASES = [{"name": "move", "duration_s": 2.0, "displacement_m": [0.5, 0.0, -0.5]}]
PERIOD_S = 0.05


def test_a_plan_is_used_from_its_arrival_on() -> None:
    """Tick and delay of every plan explain when it was used.

    A step uses, of the plans that have arrived, the newest; so its age follows from the delays.
    """
    run = transport.fly(
        "resilient", {"links.delay_s": 0.12, "links.jitter_s": 0.1}, phases=PHASES, progress=False
    )
    setup = Setup.of(run.scenario.validated, "test")
    delays = plan_delays(setup, run.log)
    used = 0
    for step in run.log.of(StepReport):
        of_step = delays[step.tick, step.agent]
        for sender, age in zip(step.peers, step.plan_ages, strict=True):
            if age < 0:
                assert sender not in of_step
                continue
            ticks = max(1, math.ceil(of_step[sender] / PERIOD_S - 1e-9))
            assert ticks <= age
            used += 1
    assert used > 400
    told = [delay for of_step in delays.values() for delay in of_step.values()]
    # Uniform, 0.1 s wide about 0.12 s.
    assert 0.07 <= min(told) < 0.08
    assert 0.16 < max(told) <= 0.17

    # The series has the same numbers, and so has the table.
    series = run.series["plan_delay_s"]
    assert series.shape == (40, 4, 4)
    assert np.isnan(series[:, range(4), range(4)]).all()
    assert series[20, 0, 2] == delays[20, 1][3]
    row = next(row for row in steps_rows(AnalysedRun.of(setup, run.log)) if row["tick"] == 20)
    assert (row["plan_delay1_s"], row["plan_delay3_s"]) == (None, delays[20, 1][3])

    # A plan counts once, at its first use.
    uses = first_uses(setup, run.log, delays)
    plans = {
        (step.agent, sender, step.tick - age)
        for step in run.log.of(StepReport)
        for sender, age in zip(step.peers, step.plan_ages, strict=True)
        if age >= 0
    }
    assert sum(map(len, uses.values())) == len(plans)


@pytest.mark.parametrize("settings", [(), ("links.override=[{from='agent2',delay_s=0.02}]",)])
def test_changes_during_the_run_count(settings: tuple[str, ...]) -> None:
    """The delay of a plan is that of its link at its tick, also after an operator has changed it."""
    run = runs.setup(runs.SHORT, *settings)
    change = LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=8,
        number=1,
        source="agent1",
        target="",
        settings='{"delay_s": 0.04}',
    )
    log = log_of([*(report(run, 3, k) for k in range(12)), change])
    delays = plan_delays(run, log)
    other_s = 0.02 if settings else 0.0
    assert [delays[k, 3].get(1) for k in (0, 8, 9, 11)] == [None, 0.0, 0.04, 0.04]
    assert {delays[k, 3][2] for k in range(1, 12)} == {other_s}


def test_the_air_comes_before_the_link() -> None:
    """With a radio the delay is that on the air and of the link; lost plans have none."""
    run = runs.setup(runs.SHORT, "radio={}", "links.delay_s=0.1")
    airtimes = [radio_report(run, k) for k in range(1, 4)]
    delays = plan_delays(run, log_of([*airtimes, *(report(run, 2, k) for k in range(1, 4))]))
    column = airtimes[0].receivers.index(2)
    for one in airtimes:
        for sender, tick, arrivals in zip(one.agents, one.plan_ticks, one.arrivals, strict=True):
            if sender == 2 or (tick + 1, 2) not in delays:
                continue
            told = delays[tick + 1, 2].get(sender)
            arrival_s = arrivals[column]
            assert told == (arrival_s + 0.1 if arrival_s >= 0.0 else None)


def test_a_perfect_network_has_no_figure_of_delays() -> None:
    """The figure is drawn where a plan was delayed, a dot for each plan."""
    for delay_s, dots in ((0.0, None), (0.03, 3 * 9)):
        run = runs.setup(runs.SHORT, f"links.delay_s={delay_s}")
        messages = [
            *(on_reference(run, k) for k in range(10)),
            *(report(run, 1, k) for k in range(10)),
        ]
        figure = Figure()
        with mpl.rc_context(RC):
            assert fill(figure, "delays", AnalysedRun.of(run, log_of(messages))) is (
                dots is not None
            )
        if dots is not None:
            drawn = [np.asarray(line.get_ydata()) for line in figure.axes[0].lines]
            drawn = [values for values in drawn if len(values) > 2]
            np.testing.assert_allclose(np.concatenate(drawn), np.full(dots, 30.0))
