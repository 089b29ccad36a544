"""Sweeps over design choices: prediction horizon, terminal weight, and the duration of the last hover."""

from collections.abc import Mapping, Sequence

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.errors import refused
from transport.experiments.experiment import SMALLEST, Experiment, check_numbers
from transport.experiments.quantities import axis

# End of the horizon in place of a terminal weight.
_COST_TO_GO = "cost-to-go"


def horizon(
    scenarios: Mapping[str, Scenario], horizons: Sequence[int], terminals: Sequence[float], delay_s: float
) -> Experiment:
    """Return every horizon combined with every terminal weight, without and with a delay of every plan.

    A horizon that ends with the cost-to-go has no terminal weight. The scenario's own horizon and weight are always
    included: on a perfect network they are the baseline.

    Args:
        scenarios: Scenarios by name or file.
        horizons: N_p, steps.
        terminals: Terminal weights, for scenarios whose horizon does not end with the cost-to-go.
        delay_s: Delay of every plan on the second network, s.
    """
    check_numbers("--horizon", horizons, "a number of steps >= 1", 1.0)
    check_numbers("--terminal", terminals, "a weight > 0", SMALLEST)
    check_numbers("--delay", [delay_s], "a delay > 0 s", SMALLEST)
    points = []
    for name, scenario in scenarios.items():
        own_horizon, (own_end, ends) = scenario.controller.horizon, _ends(scenario, terminals)
        points += [
            Point(
                scenario=name,
                labels={"network": network, "horizon": steps, "terminal": end},
                text=f"N_p {steps}, {text}, {network}",
                settings=(f"links.delay_s={network_delay_s!r}", f"controller.horizon={steps}", *settings),
                baseline=(steps, end, network_delay_s) == (own_horizon, own_end, 0.0),
            )
            for network, network_delay_s in (("perfect", 0.0), (f"{1e3 * delay_s:g} ms delay", delay_s))
            for steps in sorted({own_horizon, *horizons})
            for end, (text, settings) in ends.items()
        ]
    along = axis("horizon", "controller.horizon")
    return Experiment(name="horizon", points=tuple(points), x=along, drawn_as="variants")


def _ends(scenario: Scenario, weights: Sequence[float]) -> tuple[float | str, dict[float | str, tuple[str, list[str]]]]:
    """Return the label of a scenario's own end of the horizon; and text and settings of all ends, by label."""
    if scenario.controller.terminal == "riccati":
        return _COST_TO_GO, {_COST_TO_GO: (_COST_TO_GO, [])}
    own = float(scenario.controller.weights.terminal)
    return own, {
        weight: (f"terminal weight {weight:g}", [f"controller.weights.terminal={weight!r}"])
        for weight in sorted({own, *weights})
    }


def hover(scenarios: Mapping[str, Scenario], durations_s: Sequence[float]) -> Experiment:
    """Return the maneuver with increasing durations of the hover that ends it.

    Each maneuver must end with a hover. No run is a baseline, as mean costs of runs of different length are not
    comparable.
    """
    check_numbers("--duration", durations_s, "a duration > 0 s", SMALLEST)
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
    return Experiment(name="hover", points=tuple(points), x=axis("hover_s"))
