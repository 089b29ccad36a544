"""Labels of the varied quantities: names and units for every key."""

import pytest

from transport.experiments.declaration import axis, quantity


@pytest.mark.parametrize(
    ("key", "title", "text"),
    [
        ("links.delay_s", "delay of plans (ms)", "delay of plans 100 ms"),
        ("links.measurement.delay_s", "delay of measurements (ms)", "delay of measurements 100 ms"),
        ("links.actuation.loss", "loss to the actuators (%)", "loss to the actuators 10 %"),
        ("controller.weights.thrust", "weight on thrust (1/N²)", "weight on thrust 0.1 1/N²"),
        (
            "controller.share_threshold",
            "threshold of sharing (% of the input's range)",
            "threshold of sharing 10 % of the input's range",
        ),
        ("plant.noise.position_m", "noise of payload position (mm)", "noise of payload position 100 mm"),
        (
            "controller.limits.thrust_rate_N_s",
            "controller limits thrust rate (N/s)",
            "controller limits thrust rate 0.1 N/s",
        ),
        ("killed_s", "time at which the agent is killed (s)", "time at which the agent is killed 0.1 s"),
    ],
)
def test_titles(key: str, title: str, text: str) -> None:
    """A key with a label has its words, another one its own; the unit is that of figures, or from its name."""
    assert quantity(key).title == title
    assert quantity(key).text(0.1) == text
    assert axis("column", key).title == title
