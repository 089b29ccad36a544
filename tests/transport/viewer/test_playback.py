"""The tick that a viewer shows: paused, played, or that of an active run."""

from transport.viewer.playback import Playback

PERIOD_S = 0.05


def test_playback_pauses_plays_and_follows() -> None:
    """Paused playback stays, playing advances at its speed and stops at the end, following shows the newest tick."""
    playback = Playback(PERIOD_S, follows=False)
    assert playback.advance(1.0, 0, 100) == 0
    playback.toggle()
    assert playback.advance(1.0, 0, 100) == 20
    playback.speed = 2.0
    assert playback.advance(1.0, 0, 100) == 60
    assert playback.advance(9.0, 0, 100) == 100
    assert not playback.playing
    playback.toggle()  # from the beginning again
    assert playback.advance(0.1, 0, 100) == 4
    playback.follow(True)
    assert [playback.advance(0.1, 0, last) for last in (101, 105)] == [101, 105]
    playback.seek(50)
    assert playback.advance(1.0, 0, 110) == 50
    assert (playback.follows, playback.playing) == (False, False)


def test_playback_of_a_log_that_begins_late() -> None:
    """A recorder that joined late has no earlier ticks: playback begins at its first one, also again."""
    playback = Playback(PERIOD_S, follows=False)
    assert playback.advance(1.0, 30, 100) == 30
    playback.seek(100)
    playback.toggle()
    assert playback.advance(0.1, 30, 100) == 30
    assert playback.advance(0.1, 30, 100) == 32
