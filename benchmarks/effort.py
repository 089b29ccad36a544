"""How much is measured: all of it for the document, or a little to see that it works."""

from dataclasses import dataclass


def _climb(duration_s: float, up_m: float) -> str:
    """Setting: a climb that begins at once, so that plans differ from hover from the first tick on."""
    return f"maneuver.phase=[{{name='climb',duration_s={duration_s},displacement_m=[0.5,0,{-up_m}]}}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Sizes and repetitions.

    Attributes:
        climb: What is flown in memory, a setting: short, so that a slow second of the machine hits all compared.
        flights: Of each of the controllers whose ratios are taken, in turns.
        teams: UAVs of the teams whose step is taken apart.
        horizons: N_p of each.
        structured: N_p at which condensing is set against a solve that keeps the states.
        steps: At least so many of each are timed.
        repetitions: Of each program, and of what takes microseconds.
        programs: At most so many of a flight, from its beginning to its end.
        large_programs: The same of one agent for all, of which each takes some solvers a second; 0 for none.
        maneuver: What is flown from beginning to end, a scenario and its settings.
        processes: UAVs of the teams that fly with processes.
        flown: What they fly, a setting.
        recordings: Flights with and without a recorder, in turns.
        round_trips: Over the bare pipe, before and after each flight.
    """

    climb: str
    flights: int
    teams: tuple[int, ...]
    horizons: tuple[int, ...]
    structured: tuple[int, ...]
    steps: int
    repetitions: int
    programs: int
    large_programs: int
    maneuver: tuple[str, ...]
    processes: tuple[int, ...]
    flown: str
    recordings: int
    round_trips: int


FULL = Effort(
    climb=_climb(1.5, 1.0),
    flights=9,
    teams=(2, 4, 8, 16),
    horizons=(10, 20, 40, 80),
    structured=(10, 20, 40, 80),
    steps=400,
    repetitions=5,
    programs=30,
    large_programs=5,
    maneuver=("paper",),
    processes=(4, 8, 16),
    flown=_climb(5.0, 1.0),
    recordings=3,
    round_trips=2000,
)

QUICK = Effort(
    climb=_climb(0.5, 0.3),
    flights=1,
    teams=(2, 4),
    horizons=(10, 20),
    structured=(5,),
    steps=1,
    repetitions=1,
    programs=4,
    large_programs=0,
    maneuver=("paper", _climb(1.0, 0.5)),
    processes=(2,),
    flown=_climb(4.0, 0.5),
    recordings=1,
    round_trips=50,
)
