"""Sizes of the measurements: full for the document, quick to see that they work."""

from dataclasses import dataclass


def _climb(duration_s: float, up_m: float) -> str:
    """Return a setting: a climb that begins at once, so that plans differ from hover from the first tick on."""
    return f"maneuver.phase=[{{name='climb',duration_s={duration_s},displacement_m=[0.5,0,{-up_m}]}}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Sizes and repetitions; the defaults are those of the document."""

    climb: str = _climb(1.5, 1.0)  # maneuver in memory; short, so that a slow second affects all compared alike
    teams: tuple[int, ...] = (2, 4, 8, 16)  # numbers of UAVs whose step is measured
    horizons: tuple[int, ...] = (10, 20, 40, 80)  # N_p of the same
    large_teams: tuple[int, ...] = (32,)  # further numbers of UAVs whose step is measured at N_p = 20
    steps: int = 400  # fewest steps of each kind
    repetitions: int = 5  # of each program, and of calls that take microseconds
    programs: int = 30  # most programs taken from a run, evenly spaced
    large_programs: int = 5  # the same for the centralized controller; 0 for none
    maneuver: tuple[str, ...] = ("paper",)  # scenario and settings of the run with processes and in memory
    processes: tuple[int, ...] = (4, 8, 16)  # numbers of UAVs of the runs with processes
    process_climb: str = _climb(5.0, 1.0)  # their maneuver
    turns: int = 5  # runs without and with certificates


FULL = Effort()

QUICK = Effort(
    climb=_climb(0.5, 0.3),
    teams=(2, 4),
    horizons=(10, 20),
    large_teams=(),
    steps=1,
    repetitions=1,
    programs=4,
    large_programs=0,
    maneuver=("paper", _climb(1.0, 0.5)),
    processes=(2,),
    process_climb=_climb(4.0, 0.5),
    turns=1,
)
