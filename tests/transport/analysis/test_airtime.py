"""Radio in summary, report and viewer: the numbers of the coordinator's airtime messages."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.support.logs import log_of, record_run
from tests.support.own_classes import Bulky
from tests.support.runs import recorded, setup, ticks
from transport.analysis.airtime import radio_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.experiments.simulation import run_in_memory
from transport.log.run_folder import open_run
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Airtime
from transport.report.figures.run_figures import fill
from transport.report.figures.style import RC
from transport.report.summary_texts import radio_text
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import SceneBuilder
from transport.viewer import panel_values

TICKS = 10
AT_ONE_INSTANT = "radio={offsets='none',computation_deviation_s=0.0}"
CLOSED_LOOP = "controller.prediction=closed_loop", "controller.received_plans=by_age"
ROUNDING = 1e-9


def run_of(*settings: str) -> Setup:
    """Return a short run."""
    return setup(ticks(TICKS), *CLOSED_LOOP, *settings)


def test_numbers_of_slots() -> None:
    """With slots every plan arrives; each link has its share and delays."""
    run = run_of("radio={}")
    radio = radio_of(run, run_in_memory(run))
    assert radio is not None
    assert radio["delivered_share"] == 1.0
    assert radio["transmissions"] == 4 * (TICKS - 1)
    assert radio["repetitions"] == radio["collisions"] == 0
    assert 0.0 < radio["delay_ms"]["p50"] <= radio["delay_ms"]["p99"] <= radio["delay_ms"]["max"]
    assert len(radio["links"]) == 4 * 3
    assert {link["delivered_share"] for link in radio["links"]} == {1.0}


def test_numbers_of_slots_that_take_turns() -> None:
    """Replaced plans are no losses, nor in transit, and the line says how often each agent has a slot."""
    run = run_of("radio={standard='802.11b',rate_mbps=1.0}")
    summary = summarise(AnalysedRun.of(run, run_in_memory(run)))
    radio = summary["radio"]
    assert radio["delivered_share"] == 1.0
    assert summary["messages"]["in_transit"] == 2 * 3  # of two agents that wait for their slots
    assert radio["replaced"] == (4 * (TICKS - 1) - 2 - radio["transmissions"]) * 3
    assert radio["slots"]["cycle_ticks"] == 2
    assert radio["slots"]["plan_ms"] <= radio["slots"]["slot_ms"]
    assert radio_text(radio).endswith("a slot for each agent every 2 ticks")


def test_slots_shorter_than_a_plan_are_told() -> None:
    """The line of a run says that its slots are too short."""
    run = run_of("radio={standard='802.11b',rate_mbps=1.0,cycle_ticks=1}")
    text = radio_text(radio_of(run, run_in_memory(run)) or {})
    assert "slots of 10.50 ms are shorter than a plan, 12.3" in text


def test_no_more_time_is_busy_than_there_is() -> None:
    """Airtime messages of the exchanges of the last tick reach beyond it, and so does the time they are of."""
    run = run_of(
        "radio={standard='802.11b',rate_mbps=1.0}",
        "controller.negotiation_iterations=5",
    )
    radio = radio_of(run, run_in_memory(run))
    assert radio is not None
    # Five exchanges of four plans of 12 ms in 50 ms: the channel is never idle for long.
    assert 0.9 < radio["airtime_share"] <= 1.0


def test_slots_are_those_of_the_plans_that_were_sent(tmp_path: Path) -> None:
    """Own data count in the slots of a run's summary, also where its log is read without them."""
    own = f"agents.controller={Bulky.__module__}:Bulky"
    run = run_of("radio={standard='802.11b',rate_mbps=2.0}", own)
    radio = radio_of(run, log_of(record_run(run, tmp_path)))
    assert radio is not None
    assert radio["slots"]["cycle_ticks"] == 2
    assert 18.0 < radio["slots"]["plan_ms"] < 21.0
    assert radio_of(run, open_run(tmp_path, horizons=False).log) == radio


def test_numbers_at_one_instant() -> None:
    """With all sends at one instant there are collisions, and no delay."""
    run = run_of(AT_ONE_INSTANT)
    radio = radio_of(run, run_in_memory(run))
    assert radio is not None
    assert radio["delivered_share"] == 0.0
    assert radio["collisions"] == 4 * 3 * (TICKS - 1)
    assert radio["delay_ms"] == {"p50": None, "p99": None, "max": None}
    assert "0.0% delivered" in radio_text(radio)
    assert f"{4 * 3 * (TICKS - 1)} lost by collisions" in radio_text(radio)


def test_without_a_radio_there_are_no_numbers() -> None:
    """A run without `[radio]` has none of its numbers."""
    run = run_of()
    assert radio_of(run, run_in_memory(run)) is None


def test_the_viewer_shows_the_last_second() -> None:
    """The panel has airtime and deliveries of the ticks until the one shown."""
    run = run_of("radio={}")
    messages = recorded(run)
    history = RunHistory(run)
    history.add(messages)
    builder = SceneBuilder(run, history)
    scene = builder.at(TICKS - 1)
    assert scene.air is not None
    busy_s = sum(one.busy_s for one in messages if isinstance(one, Airtime))
    period_s = run.settings.sampling_period_s
    assert scene.air.airtime_share == pytest.approx(busy_s / ((TICKS - 1) * period_s), rel=ROUNDING)
    assert scene.air.delivered_share == 1.0
    assert "100% delivered" in panel_values.flight(scene, 1.0)

    first = builder.at(0)
    assert first.air is not None
    assert first.air.delivered_share is None
    assert np.isclose(first.air.airtime_share, 0.0)


def test_the_viewer_of_a_run_without_a_radio() -> None:
    """The panel has no row for a radio that is not there."""
    run = run_of()
    history = RunHistory(run)
    history.add(recorded(run))
    assert "radio" not in panel_values.flight(SceneBuilder(run, history).at(3), 1.0)


def test_the_figure_has_airtime_deliveries_and_delays() -> None:
    """A run with a radio has a figure of it, one without has none."""
    for settings, expected in (("radio={}",), 3), ((), 0):
        run = run_of(*settings)
        log = run_in_memory(run)
        figure = Figure()
        with mpl.rc_context(RC):
            drawn = fill(figure, "radio", AnalysedRun.of(run, log))
        assert drawn == bool(expected)
        assert len(figure.axes) == expected
