"""Section of the radio that the team shares (docs/radio.md)."""

from typing import Annotated, Literal

from annotated_types import Interval

from transport.model.section import LAG_S, Key, NotNegative, Positive, Section


class RadioSection(Section):
    """One half-duplex 802.11 channel for the plans of the team, in lockstep; without the section there is none."""

    standard: Literal["802.11a", "802.11b"] = "802.11a"
    """physical layer: OFDM at 5 GHz, or DSSS and CCK at 2.4 GHz"""
    rate_mbps: Annotated[Positive, Key(unit="Mb/s", label="rate of the radio")] = 6.0
    """rate of all plans: 6, 9, 12, 18, 24, 36, 48, 54 with 802.11a; 1, 2, 5.5, 11 with 802.11b"""
    delivery: Annotated[Literal["broadcast", "unicast"], Key(label="delivery")] = "broadcast"
    """broadcast: one frame for all agents, never repeated; unicast: one for each, acknowledged and repeated"""
    attempts: Annotated[int, Interval(ge=1, le=100)] = 7
    """with unicast: transmissions of a frame until it is given up"""
    queue_length: Annotated[int, Interval(ge=1, le=10_000)] = 64
    """frames that wait at a UAV, with the one on the air; a further one is lost"""
    inputs: Annotated[Literal["all", "first"], Key(label="inputs on the air")] = "all"
    """inputs of a plan on the air: those of the whole horizon, or the first ([radio.md](../radio.md#half-the-bytes))"""
    offsets: Annotated[Literal["none", "slots", "random"], Key(label="offsets of sends")] = "slots"
    """when an agent sends: as soon as its plan is computed, in its own slot of the period, or at a random instant"""
    cycle_ticks: Annotated[int, Interval(ge=1, le=1000)] | None = None
    """with slots: ticks in which each agent has one slot; if omitted, the fewest in which a plan fits into it"""
    computation_mean_s: Annotated[
        NotNegative, Key(within=LAG_S, label="time of computation", shown="ms")
    ] = 0.005
    """mean time from a tick to the plan of an agent; a model, independent of the host"""
    computation_deviation_s: Annotated[
        NotNegative, Key(within=LAG_S, label="deviation of the time of computation", shown="ms")
    ] = 0.001
    """standard deviation of that time, normal, independent for each agent and tick"""
    power_mw: Annotated[Positive, Key(unit="mW", label="transmit power")] = 40.0
    """transmit power; 40 mW are 16 dBm"""
    path_loss_exponent: Annotated[float, Interval(ge=1.0, le=8.0)] = 3.0
    """exponent of the log-distance path loss; 2 in free space"""
    path_loss_1m_db: Annotated[float | None, Interval(ge=0.0, le=200.0), Key(unit="dB")] = None
    """path loss at 1 m; if omitted, that of free space: 46.7 dB with 802.11a, 40.2 dB with 802.11b"""
    shadowing_db: Annotated[float, Interval(ge=0.0, le=40.0), Key(unit="dB")] = 0.0
    """standard deviation of the shadowing, normal, constant for each pair of UAVs"""
    noise_figure_db: Annotated[float, Interval(ge=0.0, le=40.0), Key(unit="dB")] = 7.0
    """noise figure of the receivers"""
    sensitivity_dbm: Annotated[float, Interval(ge=-150.0, le=50.0), Key(unit="dBm")] = -82.0
    """power below which no frame is detected"""
    carrier_sense_dbm: Annotated[float, Interval(ge=-150.0, le=50.0), Key(unit="dBm")] = -82.0
    """total power from which the channel is busy although no frame is detected"""
    capture_db: Annotated[float, Interval(ge=0.0, le=60.0), Key(unit="dB")] = 4.0
    """signal over noise and interference from which a frame is detected"""
    background: Annotated[float, Interval(ge=0.0, lt=1.0), Key(label="traffic of others")] = 0.0
    """share of the airtime that others offer, whom all UAVs hear"""
