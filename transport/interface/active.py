"""An active run in Python: targets for it while it flies."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from protocol.scenario.files import points_of
from protocol.scenario.targets import asked
from protocol.wire.names import COORDINATOR
from transport.flight import live
from transport.interface.settings import ArgumentError

Point = Sequence[float]


class ActiveRun:
    """A run that is active on this machine, in its run folder `folder`."""

    def __init__(self, folder: Path, there: live.LiveRun) -> None:
        self.folder, self._there = folder, there

    def __repr__(self) -> str:
        return f"ActiveRun({str(self.folder)!r})"

    def target(self, x: float, y: float, z: float, *, speed: float | None = None) -> dict[str, Any]:
        """Send the payload to a position, inertial frame (z down), m, from the next tick on.

        The largest speed, m/s, is up to 1 m/s, if feasible, by default.

        Returns: `tick`, its time `t_s`, and when the reference is there, `reached_s` and `ends_s`, s.
        Raises: TransportError: it cannot be flown, or the run does not answer.
        """
        return self._asked([[x, y, z]], None, speed)

    def path(
        self,
        points: "Sequence[Point] | str | PathLike[str]",
        *,
        times: Sequence[float] | None = None,
        speed: float | None = None,
    ) -> dict[str, Any]:
        """Send the payload through way points on a smooth curve, after it has reached the first of them.

        Args:
            points: Positions, (k, 3), inertial frame, m; or a CSV file with columns x,y,z or t,x,y,z.
            times: Their times, s, counted from that of the first one, instead of a speed.
            speed: Largest speed, m/s.
        Returns: As `target`. Raises: also TransportError: of the file.
        """
        if isinstance(points, str | PathLike):
            points, times = points_of(Path(points))
        return self._asked(points, times, speed)

    def _asked(self, points: Sequence[Point], times: Sequence[float] | None, speed: float | None) -> dict[str, Any]:
        given: dict[str, Any] = {"points_m": [[float(value) for value in point] for point in points]}
        given |= {} if times is None else {"times_s": [float(value) for value in times]}
        given |= {} if speed is None else {"speed_mps": float(speed)}
        asked(given)
        return self._there.ask(COORDINATOR, "target", given)


def active(folder: "str | PathLike[str] | None" = None) -> ActiveRun:
    """Return the active run of a folder, by default the most recent one in `runs`; raise ArgumentError without one."""
    found = live.newest_folder(Path("runs")) if folder is None else Path(folder)
    there = None if found is None else live.read(found)
    if found is None or there is None:
        raise ArgumentError(f"no active run in {'runs' if folder is None else folder}")
    return ActiveRun(found, there)
