"""Experiment with the radio that the team itself fills (docs/radio.md)."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import get_args

from transport.experiments.cases import Point, check_names
from transport.experiments.declaration import NONE, Values, declared
from transport.protocol.radio.send_times import Offsets
from transport.protocol.radio.standards_80211 import OFDM

OFFSETS = get_args(Offsets)
SHARING = ("always", "on_change")
Labels = dict[str, str | float]
_EXPONENT = 3.0  # of the path loss
_LOSS_1M_DB = 46.7


@declared(
    "uavs",
    drawn_as="radio",
    curves="variant",
    scenarios=(),
    # The paper's speed, 0.5 m/s, in a maneuver of 10 s instead of 25.
    maneuver="maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
    "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]",
    max=Values(16, "COUNT", "UAVs of the largest team.", 4, least=3, most=32),
    sizes=Values([3, 4, 8, 16, 32], quick=[3]),  # those below the largest
    rate=Values([6.0, 24.0], "MBPS", "Rate of 802.11a, Mb/s.", quick=[6.0]),
    offsets=Values(["slots", "none"], "NAME", "Offsets of the sends: slots, none, random."),
    sharing=Values(["always"], "NAME", "Plans sent: always, on_change."),
    distance=Values([1.0], "FACTOR", "Distances on the air over those of the team.", least=1e-3),
)
def radio(
    max: int,  # noqa: A002  # the name of the option
    sizes: Sequence[int],
    rate: Sequence[float],
    offsets: Sequence[str],
    sharing: Sequence[str],
    distance: Sequence[float],
) -> Iterator[Point]:
    """Effect of the radio channel that the team itself fills.

    Teams of 3 to 16 UAVs made from `resilient`, with an agent for every UAV, by rate and offsets of
    the sends; each is compared to the same team without a radio.

    Example: transport experiment radio --max 32 --rate 24 --offsets slots --sharing on_change
    """
    check_names("--rate", [f"{mbps:g}" for mbps in rate], [f"{mbps:g}" for mbps in OFDM.rates_mbps])
    check_names("--offsets", offsets, OFFSETS)
    check_names("--sharing", sharing, SHARING)
    for uavs in [*(size for size in sizes if size < max), max]:
        group = f"{uavs} UAVs"
        without: Labels = {"variant": NONE, "uavs": uavs}
        yield _point(without, f"{group} without a radio", (), group, baseline=True)
        for mbps, offset, shared, factor in itertools.product(rate, offsets, sharing, distance):
            words = [f"{mbps:g} Mb/s", _OFFSETS_IN_WORDS[offset]]
            words += ["on change"] * (shared == "on_change")
            words += [f"{factor:g} times the distance"] * (factor != 1.0)
            variant = ", ".join(words)

            loss_db = _LOSS_1M_DB + 10.0 * _EXPONENT * math.log10(factor)
            section = (
                f"radio={{rate_mbps={mbps!r},offsets='{offset}',"
                f"path_loss_exponent={_EXPONENT},path_loss_1m_db={loss_db!r}}}"
            )
            settings = (section, f"controller.share={shared}")
            labels: Labels = {"variant": variant, "uavs": uavs}
            yield _point(labels, f"{group}, {variant}", settings, group)


def _point(
    labels: Labels, text: str, settings: tuple[str, ...], group: str, *, baseline: bool = False
) -> Point:
    """Return a point with a team of one UAV for each agent."""
    team = int(labels["uavs"]), 1
    return Point(labels, text, settings, baseline, group, team, "resilient")


_OFFSETS_IN_WORDS = {"slots": "slots", "none": "no offsets", "random": "random offsets"}
