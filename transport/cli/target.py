"""The command `transport target`."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from protocol.scenario.files import TableError, points_of
from protocol.scenario.targets import TargetError, asked
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.names import COORDINATOR
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, with_options
from transport.cli.output import Format, exit_on, fail, show_json


@with_options(ActiveRun)
def target(
    run: ActiveRun,
    x: Annotated[float | None, Argument(metavar="X", help="Position in the inertial frame, m: forwards.")] = None,
    y: Annotated[float | None, Argument(metavar="Y", help="To the right.")] = None,
    z: Annotated[float | None, Argument(metavar="Z", help="Downwards.")] = None,
    speed: Annotated[
        float | None, Option("--speed", metavar="MPS", min=1e-3, help="Largest speed; else up to 1 m/s, if feasible.")
    ] = None,
    file: Annotated[
        Path | None,
        Option("--file", metavar="CSV", help="Way points instead: columns x,y,z, or t,x,y,z without --speed."),
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Send the payload of an active run to a target.

    From the next tick on the reference leaves its path smoothly, also that to an earlier target, and comes to rest
    there. A target that cannot be flown is refused with the reason. Way points are run through on a smooth curve after
    the first one.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport target 3 0 -12 --speed 1.5
    """
    point = [value for value in (x, y, z) if value is not None]
    if len(point) != (3 if file is None else 0):
        fail(f"expected X Y Z, or --file, got {len(point)} numbers{' and --file' if file else ''}", EXIT_USAGE)
    given: dict[str, Any] = {"points_m": [point]}
    if file is not None:
        with exit_on(TableError, code=EXIT_USAGE, option="--file"):
            points, times_s = points_of(file)
        given = {"points_m": points, **({} if times_s is None else {"times_s": times_s})}
    given |= {} if speed is None else {"speed_mps": speed}
    with exit_on(TargetError, code=EXIT_USAGE):
        asked(given)
    answer = run.ask(COORDINATOR, "target", given)
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(in_words(answer))


def in_words(answer: dict[str, Any]) -> str:
    """Return the coordinator's answer to a target as a sentence."""
    further = f", the last way point at t = {answer['ends_s']:.2f} s" if answer["ends_s"] > answer["reached_s"] else ""
    return (
        f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s), "
        f"reached at t = {answer['reached_s']:.2f} s{further}"
    )


target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]  # -2 is no option
