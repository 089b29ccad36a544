"""What choices of ours decide: the prediction horizon, the terminal weight, and how long the team hovers at the end."""

import math
from collections.abc import Mapping, Sequence

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.catalogue import Axis, Experiment
from transport.experiments.errors import refused


def horizon(
    scenarios: Mapping[str, Scenario], horizons: Sequence[int], terminals: Sequence[float], delay_s: float
) -> Experiment:
    """Every horizon with every terminal weight, on a perfect network and with a delay of every plan.

    The scenario's own horizon and weight are always among them: on a perfect network they are what all others are
    compared to.

    Args:
        scenarios: What is run, by name or file.
        horizons: N_p, steps.
        terminals: Terminal weights, where a scenario depends on one.
        delay_s: Delay of every plan on the second network.
    """
    _check("--horizon", horizons, "a number of steps >= 1", 1.0)
    _check("--terminal", terminals, "a weight > 0", math.nextafter(0.0, 1.0))
    _check("--delay", [delay_s], "a delay > 0 s", math.nextafter(0.0, 1.0))
    points = []
    for name, scenario in scenarios.items():
        own_horizon, own_terminal = scenario.controller.horizon, float(scenario.controller.weights.terminal)
        weights = sorted({own_terminal, *(terminals if varies_terminal(scenario) else ())})
        for network, network_delay_s in (("perfect", 0.0), (f"{1e3 * delay_s:g} ms delay", delay_s)):
            points += [
                Point(
                    scenario=name,
                    labels={"network": network, "horizon": steps, "terminal": weight},
                    text=f"N_p {steps}, terminal weight {weight:g}, {network}",
                    settings=(
                        f"links.delay_s={network_delay_s!r}",
                        f"controller.horizon={steps}",
                        f"controller.weights.terminal={weight!r}",
                    ),
                    baseline=(steps, weight, network_delay_s) == (own_horizon, own_terminal, 0.0),
                )
                for steps in sorted({own_horizon, *horizons})
                for weight in weights
            ]
    return Experiment(name="horizon", points=tuple(points), x=Axis("horizon", "N_p"), drawn_as="variants")


def varies_terminal(scenario: Scenario) -> bool:
    """Whether the terminal weight is varied: a Riccati cost-to-go takes its place."""
    return scenario.controller.terminal == "multiple"


def hover(scenarios: Mapping[str, Scenario], durations_s: Sequence[float]) -> Experiment:
    """The maneuver with a longer and longer hover as its last phase.

    Mean costs over runs of different length are not compared: no run is a baseline.

    Args:
        scenarios: What is run, by name or file; each maneuver has to end with a hover.
        durations_s: Of the last phase, s.
    """
    _check("--duration", durations_s, "a duration > 0 s", math.nextafter(0.0, 1.0))
    points = []
    for name, scenario in scenarios.items():
        phases = scenario.maneuver.phase
        if any(phases[-1].displacement_m):
            raise refused("--scenario", "a maneuver that ends with a hover", f"{name}, whose last is {phases[-1].name}")
        points += [
            Point(
                scenario=name,
                labels={"hover_s": duration_s},
                text=f"{duration_s:g} s of hover",
                settings=(f"maneuver.phase.{len(phases)}.duration_s={duration_s!r}",),
            )
            for duration_s in sorted(durations_s)
        ]
    return Experiment(name="hover", points=tuple(points), x=Axis("hover_s", "duration of the last hover (s)"))


def _check(option: str, values: Sequence[float], expected: str, low: float) -> None:
    for value in values:
        if not low <= value < math.inf:
            raise refused(option, expected, f"{value:g}")
        if values.count(value) > 1:
            raise refused(option, "each value once", f"{value:g} {values.count(value)} times")
