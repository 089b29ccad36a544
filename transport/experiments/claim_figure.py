"""The paper's Fig. 3, 5 and 6 side by side: one maneuver under different controllers."""

from collections.abc import Sequence
from pathlib import Path

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message
from transport.analysis.series import Series, series_of
from transport.flight import memory
from transport.log.run_log import Recorded, RunLog
from transport.report.figures import PERFORMANCE, plot_performance
from transport.report.style import RC, save

_COLUMN_IN, _HEIGHT_IN = 3.0, 7.4

# The cost's axis ends so far below its highest value: what is smaller is rounding.
_DECADES = 1e-5


def draw(flights: Sequence[tuple[str, Setup]], folder: Path) -> list[Path]:
    """Fly each once more and draw them next to each other, on the same axes.

    Args:
        flights: Heading and setup of each column; deterministic, so this is the flight that was measured.
        folder: Where to.
    Returns: maneuver.png and maneuver.svg.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    columns = [(title, setup, _flown(setup)) for title, setup in flights]
    with mpl.rc_context({**RC, "svg.hashsalt": "maneuver"}):
        figure = Figure(figsize=(_COLUMN_IN * len(columns), _HEIGHT_IN), layout="constrained")
        panels = figure.subplots(len(PERFORMANCE), len(columns), sharex=True, squeeze=False)
        for place, (title, setup, series) in enumerate(columns):
            own = list(panels[:, place])
            plot_performance(setup, series, own)
            own[0].set_title(title, pad=18.0)
            own[-1].set_xlabel("time (s)")
        for label, row in zip(PERFORMANCE, panels, strict=True):
            row[0].set_ylabel(label)
            low = min(panel.get_ylim()[0] for panel in row)
            high = max(panel.get_ylim()[1] for panel in row)
            for panel in row:
                panel.set_ylim(max(low, high * _DECADES) if panel.get_yscale() == "log" else low, high)
                panel.label_outer()
        for panel in panels[:-1, -1]:
            panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
        figure.align_ylabels(panels[:, 0])
        return [save(figure, folder / f"maneuver.{kind}") for kind in ("png", "svg")]


def _flown(setup: Setup) -> Series:
    messages: list[Recorded] = []

    def record(message: Message) -> None:
        messages.append(Recorded(message=message, received_ns=0))

    memory.simulate(setup, record)
    return series_of(setup, RunLog(header={}, messages=tuple(messages), cut=""))
