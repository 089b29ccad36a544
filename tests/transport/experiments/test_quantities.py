"""Labels of the varied quantities: names and units for every key."""

import pytest

from protocol.scenario.keys import sections
from transport.experiments.quantities import QUANTITIES, axis, quantity

# Units of the figures by the unit of the key and the factor between them.
_CONVERTED = {("s", 1e3): "ms", ("", 100.0): "%", ("m", 1e3): "mm", ("m/s", 1e3): "mm/s"}
# Units that keys.toml gives in words.
_WORDS = {("controller.horizon", ""): "steps", ("links.rate_hz", "1/s"): "1/s"}


def units() -> dict[str, str]:
    """Return the unit of each key of the scenario; links from and to the plant have the keys of all links."""
    found = {f"{s.path}.{key.name}".lstrip("."): key.unit for s in sections() for key in s.keys}
    links = {name.removeprefix("links."): unit for name, unit in found.items() if name.startswith("links.")}
    return found | {f"links.{way}.{name}": unit for way in ("measurement", "actuation") for name, unit in links.items()}


def test_the_table_has_keys_of_the_scenario() -> None:
    """Every dotted key in the table is a key of the scenario, with its unit, converted by the factor."""
    known = units()
    assert "links.delay_s" in QUANTITIES
    for key, found in QUANTITIES.items():
        if "." not in key:
            continue
        assert key in known, key
        if key == "controller.share_threshold":  # a share of the range, in percent
            assert (found.unit, found.factor) == ("% of the input's range", 100.0)
            continue
        own = _WORDS.get((key, known[key]), known[key])
        assert found.unit == _CONVERTED.get((own, found.factor), own), key
        assert found.factor == 1.0 or (own, found.factor) in _CONVERTED, key


@pytest.mark.parametrize(
    ("key", "title", "text"),
    [
        ("links.delay_s", "delay of plans (ms)", "delay of plans 100 ms"),
        ("links.loss", "loss of plans (%)", "loss of plans 10 %"),
        ("controller.weights.terminal", "terminal weight", "terminal weight 0.1"),
        ("plant.mujoco.rod_mass_kg", "plant mujoco rod mass (kg)", "plant mujoco rod mass 0.1 kg"),
        (
            "controller.limits.thrust_rate_N_s",
            "controller limits thrust rate (N/s)",
            "controller limits thrust rate 0.1 N/s",
        ),
    ],
)
def test_titles(key: str, title: str, text: str) -> None:
    """A key in the table has its words; another one its own, with the unit its name ends with."""
    assert quantity(key).title == title
    assert quantity(key).text(0.1) == text
    assert axis("column", key).title == title


def test_every_key_gets_the_unit_of_its_name() -> None:
    """The unit of a key that is not in the table, taken from its name, is that of docs/keys.md."""
    for key, unit in units().items():
        found = quantity(key)
        if key not in QUANTITIES and found.unit:
            assert unit in (found.unit, ""), key
