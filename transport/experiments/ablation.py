"""What each part of the algorithm is worth: one setting changed at a time, on a good and on a bad network."""

from collections.abc import Mapping
from typing import Any

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.catalogue import Axis, Experiment

AS_IT_IS = "as it is"

# Settings of each part, by what it is called. Those that a scenario has anyway, or that are refused with its other
# settings, are left out there.
PARTS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "prediction": ("controller.prediction", ("open_loop", "closed_loop")),
    "terminal": ("controller.terminal", ("multiple", "riccati")),
    "preview": ("controller.preview", ("false", "true")),
    "relaxation": ("controller.relaxation", ("1.0", "0.5", "0.25", "0.1")),
    "negotiation_iterations": ("controller.negotiation_iterations", ("1", "2", "4")),
    "received plans": ("controller.received_plans", ("by_age", "by_one", "held")),
    "received states": ("controller.received_states", ("predicted", "as_received")),
    "actuation": ("clock.actuation", ("immediate", "next_tick")),
    "discretisation": ("controller.discretisation", ("exact", "euler")),
}

NETWORKS: Mapping[str, tuple[str, ...]] = {
    "perfect": ("links.delay_s=0.0", "links.loss=0.0"),
    "200 ms delay, 30 % loss": ("links.delay_s=0.2", "links.loss=0.3"),
}


def ablation(scenarios: Mapping[str, Scenario]) -> Experiment:
    """Every part of every scenario changed on its own, on every network.

    Args:
        scenarios: What is flown, by name or file.
    """
    points = []
    for name, scenario in scenarios.items():
        for network, links in NETWORKS.items():
            variants = [(AS_IT_IS, "", ())] + [
                (part, value, (f"{key}={value}",))
                for part, (key, values) in PARTS.items()
                for value in values
                if not _has(scenario, key, value) and _is_possible(scenario, key, value)
            ]
            points += [
                Point(
                    scenario=name,
                    labels={"network": network, "part": part, "value": value},
                    text=f"{part}{' ' if value else ''}{value}, {network}",
                    settings=(*links, *settings),
                    baseline=part == AS_IT_IS and network == "perfect",
                )
                for part, value, settings in variants
            ]
    return Experiment(name="ablation", points=tuple(points), x=Axis("value", "variant"), drawn_as="variants")


def _has(scenario: Scenario, key: str, value: str) -> bool:
    """Whether a scenario has a value anyway."""
    if key == "clock.actuation":
        return value == ("next_tick" if scenario.clock.next_tick else "immediate")
    own: Any = scenario.tree()
    for name in key.split("."):
        own = own[name]
    text = str(own).lower() if isinstance(own, bool) else str(own)
    return text == value or (own == "auto" and value == str(1.0 / len(scenario.owned)))


def _is_possible(scenario: Scenario, key: str, value: str) -> bool:
    """Return whether a value can be combined with the scenario's other settings (docs/scenario.md, `[controller]`)."""
    controller = scenario.controller
    chosen = {
        "controller.prediction": controller.prediction,
        "controller.terminal": controller.terminal,
        "controller.preview": str(controller.preview).lower(),
        key: value,
    }
    if chosen["controller.terminal"] == "riccati":
        return bool(controller.weights.penalised_input == "deviation")
    return chosen["controller.preview"] == "false" or chosen["controller.prediction"] == "closed_loop"
