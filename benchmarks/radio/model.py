"""A case in protocol/radio."""

from benchmarks.radio.cases import PERIOD_NS, Case, end_ns, sends
from benchmarks.radio.reference import Arrivals
from transport.protocol.radio.channel_settings_and_state import ChannelParameters, ChannelState
from transport.protocol.radio.frames import Frame, FrameResult
from transport.protocol.radio.medium_access_and_retries import Channel
from transport.protocol.radio.propagation import Propagation, milliwatts, noise_mw, ratio
from transport.protocol.radio.standards_80211 import STANDARDS


def parameters(case: Case, *, draws: bool) -> ChannelParameters:
    """Return the channel of a case."""
    standard = STANDARDS[case.standard]
    return ChannelParameters(
        standard=standard,
        rate_mbps=case.rate_mbps,
        unicast=case.unicast,
        queue_length=case.queue_length,
        attempts=case.attempts,
        noise_mw=noise_mw(standard.bandwidth_hz, case.noise_figure_db),
        sensitivity_mw=milliwatts(case.sensitivity_dbm),
        carrier_sense_mw=milliwatts(case.carrier_sense_dbm),
        preamble_ratio=ratio(case.preamble_snr_db),
        interrupted_wait_draws=draws,
        seed=case.seed,
    )


def run(case: Case, *, draws: bool = False) -> Arrivals:
    """Return arrivals by send and receiver, ns.

    `draws` is the standard's rule for a frame that meets an idle medium; ns-3 has the other one.
    """
    stations = len(case.positions)
    propagation = Propagation(
        power_mw=milliwatts(case.power_dbm),
        exponent=case.exponent,
        reference_loss_db=case.reference_loss_db,
    )
    powers = propagation.powers(propagation.at_reference(stations), case.positions)
    everyone = range(stations)
    frames = [
        Frame(
            send.time_ns,
            send.sender,
            number,
            case.message_bytes,
            tuple(j for j in everyone if j != send.sender)
            if send.receiver < 0
            else (send.receiver,),
        )
        for number, send in enumerate(sends(case))
    ]
    channel = Channel(parameters(case, draws=draws))
    state = ChannelState.idle(stations, STANDARDS[case.standard])
    arrivals: Arrivals = {}
    place = 0
    for until in range(2 * PERIOD_NS, end_ns(case) + PERIOD_NS, PERIOD_NS):
        begin = place
        while place < len(frames) and frames[place].sent_ns < until:
            place += 1
        state, outcomes, _ = channel.advance(state, powers, frames[begin:place], until)
        for outcome in outcomes:
            if outcome.result is FrameResult.DELIVERED:
                arrivals[outcome.frame.sequence, outcome.receiver] = outcome.time_ns
    return arrivals
