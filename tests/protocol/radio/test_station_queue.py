"""One station: idle slots are counted, a busy medium freezes its backoff, a running backoff goes on."""

from transport.protocol.radio.standards_80211 import OFDM
from transport.protocol.radio.station_queue import Station

SLOT_NS, DIFS_NS = OFDM.slot_ns, OFDM.difs_ns
SEED = 1
END_NS = 1_000_000  # of the activity before
SLOTS = 5


def backing_off() -> Station:
    """Return a station whose backoff counts from DIFS after an activity on."""
    station = Station.idle(0, OFDM)
    station.busy_until = END_NS
    station.slots = SLOTS
    return station


def test_a_backoff_ends_after_its_idle_slots() -> None:
    """Counting them in between, also within a slot, does not move its end."""
    station = backing_off()
    end_ns = END_NS + DIFS_NS + SLOTS * SLOT_NS
    assert station.due() == end_ns
    station.count_down(END_NS + DIFS_NS + 2 * SLOT_NS + SLOT_NS // 2)
    assert (station.slots, station.due()) == (SLOTS - 2, end_ns)


def test_a_busy_medium_freezes_the_backoff() -> None:
    """Slots that were idle before are done; the others count from DIFS behind the activity on."""
    station = backing_off()
    begin_ns = END_NS + DIFS_NS + 2 * SLOT_NS
    until_ns = begin_ns + 300_000
    station.sense(until_ns, begin_ns, redraw_seed=None)
    assert station.due() == until_ns + DIFS_NS + (SLOTS - 2) * SLOT_NS


def test_a_frame_waits_for_a_running_backoff_or_for_difs() -> None:
    """It draws none behind the end of an activity; one that meets an activity does."""
    running = backing_off()
    running.request(SEED, END_NS + DIFS_NS + 3 * SLOT_NS)
    assert (running.slots, running.backoffs) == (SLOTS - 3, 0)
    assert running.due() == backing_off().due()
    for now_ns, draws in ((END_NS - 1, 1), (END_NS, 0)):
        station = backing_off()
        station.slots = 0
        station.request(SEED, now_ns)
        assert station.backoffs == draws
        assert station.waits_without_backoff is not bool(draws)
    assert station.due() == END_NS + DIFS_NS
