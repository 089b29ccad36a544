"""Margins of a scenario: how far the plant may differ from the controllers' model."""

from collections.abc import Collection
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any, Unpack

from protocol.scenario.setup import Setup
from transport.interface.figure import RunFigure, drawn
from transport.interface.scenario import Scenario
from transport.interface.settings import Settings, ShortSettings
from transport.report.margins import ACTUATIONS, HoverMargins, draw, hover_margins, notes, rows


@dataclass(frozen=True)
class Margins:
    """Margins of the hover of a scenario, as `transport.margins` returns them; printed as a table."""

    found: HoverMargins  # SI units, factors relative to the known value

    @property
    def data(self) -> dict[str, Any]:
        """Margins by actuation and property, as plain values; None is beyond the searched range."""
        return asdict(self.found)

    def plot(self) -> RunFigure:
        """Return the ranges as a figure."""
        return drawn(lambda figure: draw(self.found, figure))

    def __str__(self) -> str:
        table = [("property", *ACTUATIONS), *rows(self.found)]
        lines = ["".join(f"{text:20s}" for text in row).rstrip() for row in table]
        return "\n".join([*lines, *notes(self.found)])


def margins(
    scenario: "str | PathLike[str] | Scenario" = "resilient",
    settings: Settings | None = None,
    *,
    without: Collection[int] = (),
    **short: Unpack[ShortSettings],
) -> Margins:
    """Return how far the plant may differ from the controllers' model before the hover becomes unstable.

    A linear analysis of the sampled loop about hover, without limits and constraints; it takes seconds. The agents in
    `without`, 1-based, are gone for good, and their UAVs follow the fail-safe; the team that is left holds the payload
    if all deviations decay (`settling_s`). Other arguments are those of `fly`.

    >>> import transport
    >>> lag_s = transport.margins("resilient").data["margins"]["immediate"]["lag_s"]
    >>> round(1e3 * lag_s["upper"])
    71

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is.
    """
    chosen = Scenario(scenario, settings, **short)
    return Margins(hover_margins(Setup.of(chosen.validated, str(chosen.file)), without))
