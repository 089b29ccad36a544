"""Ablation: one setting of the algorithm changed at a time, on a good and on a bad network."""

from collections.abc import Mapping
from typing import Any

from protocol.scenario.schema import Scenario
from transport.experiments.cases import Point
from transport.experiments.experiment import Experiment
from transport.experiments.network_sweeps import NETWORKS
from transport.experiments.quantities import Axis

AS_IT_IS = "as it is"

# Settings of each part by its name. Those that a scenario has anyway, or that conflict with its other settings, are
# left out.
PARTS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "prediction": ("controller.prediction", ("open_loop", "closed_loop")),
    "terminal": ("controller.terminal", ("multiple", "riccati")),
    "preview": ("controller.preview", ("false", "true")),
    "relaxation": ("controller.relaxation", ("1.0", "0.5", "0.25", "0.1")),
    "negotiation iterations": ("controller.negotiation_iterations", ("1", "2", "4")),
    "received plans": ("controller.received_plans", ("by_age", "by_one", "held")),
    "received states": ("controller.received_states", ("predicted", "as_received")),
    "actuation": ("clock.actuation", ("immediate", "next_tick")),
    "discretisation": ("controller.discretisation", ("exact", "euler")),
}


def ablation(scenarios: Mapping[str, Scenario]) -> Experiment:
    """Return every part of every scenario changed on its own, on every network."""
    points = []
    for name, scenario in scenarios.items():
        variants = [(AS_IT_IS, "", "")] + [
            (part, value, f"{key}={value}")
            for part, (key, values) in PARTS.items()
            for value in values
            if not _has(scenario, key, value) and _is_possible(scenario, key, value)
        ]
        points += [
            Point(
                scenario=name,
                labels={"network": network, "part": part, "value": value},
                text=f"{part}{' ' if value else ''}{value}, {network}",
                settings=(*links, setting) if setting else links,
                baseline=part == AS_IT_IS and network == "perfect",
            )
            for network, links in NETWORKS.items()
            for part, value, setting in variants
        ]
    return Experiment(name="ablation", points=tuple(points), x=Axis("value", "variant"), drawn_as="variants")


def _has(scenario: Scenario, key: str, value: str) -> bool:
    """Return whether a scenario has a value already."""
    if key == "clock.actuation":
        return value == ("next_tick" if scenario.clock.next_tick else "immediate")
    own: Any = scenario.tree()
    for name in key.split("."):
        own = own[name]
    text = str(own).lower() if isinstance(own, bool) else str(own)
    return text == value or (own == "auto" and value == str(1.0 / len(scenario.owned)))


def _is_possible(scenario: Scenario, key: str, value: str) -> bool:
    """Return whether a value can be combined with the scenario's other settings (docs/keys.md, `[controller]`)."""
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
