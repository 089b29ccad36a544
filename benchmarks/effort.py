"""Sizes of the measurements: full for the document, quick to see that they work."""

from dataclasses import dataclass


def _climb(duration_s: float, up_m: float) -> str:
    """Return a setting: a climb that begins at once, so that plans differ from hover from the first tick on."""
    return f"maneuver.phase=[{{name='climb',duration_s={duration_s},displacement_m=[0.5,0,{-up_m}]}}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Sizes and repetitions; the defaults are those of the document.

    Attributes:
        climb: Maneuver of runs in memory; short, so that a slow second of the machine affects all compared alike.
        turns: Runs in memory of each controller compared.
        teams: Numbers of UAVs whose step is measured.
        horizons: N_p of the same.
        steps: Fewest steps of each kind.
        repetitions: Repetitions of each program, and of calls that take microseconds.
        programs: Most programs taken from a run, evenly spaced.
        large_programs: The same for the centralized controller; 0 for none.
        maneuver: Scenario and settings of the run compared with processes and in memory.
        processes: Numbers of UAVs of the runs with processes.
        process_climb: Their maneuver.
        recordings: Runs with and without recorder.
        floods: Runs with keys and under floods.
        round_trips: Messages over the bare pipe, before and after each run.
    """

    climb: str = _climb(1.5, 1.0)
    turns: int = 9
    teams: tuple[int, ...] = (2, 4, 8, 16)
    horizons: tuple[int, ...] = (10, 20, 40, 80)
    steps: int = 400
    repetitions: int = 5
    programs: int = 30
    large_programs: int = 5
    maneuver: tuple[str, ...] = ("paper",)
    processes: tuple[int, ...] = (4, 8, 16)
    process_climb: str = _climb(5.0, 1.0)
    recordings: int = 3
    floods: int = 5
    round_trips: int = 2000


FULL = Effort()

QUICK = Effort(
    climb=_climb(0.5, 0.3),
    turns=1,
    teams=(2, 4),
    horizons=(10, 20),
    steps=1,
    repetitions=1,
    programs=4,
    large_programs=0,
    maneuver=("paper", _climb(1.0, 0.5)),
    processes=(2,),
    process_climb=_climb(4.0, 0.5),
    recordings=1,
    floods=1,
    round_trips=50,
)
