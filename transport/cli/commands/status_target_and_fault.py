"""Commands that ask or change an active run: `status`, `fault`, `target`, `land`, `abort`, `release`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from typer import Argument, Option

from transport.cli.active import ActiveRunOption, process_name
from transport.cli.lazy import with_options
from transport.cli.options import FormatOption
from transport.cli.output import Format, blame, facts, fail, show
from transport.protocol.scenario.files.named_files import points_of
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.wire.names import COORDINATOR, RECORDER


@with_options(ActiveRunOption)
def status(
    run: ActiveRunOption,
    process: str | None = Option(
        None,
        metavar="PROCESS",
        help="Number of an agent, agent1, ..., plant, coordinator or recorder.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Show the progress of a run, or the health of one process.

    Tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    asked, kind = (COORDINATOR, "status") if process is None else (process_name(process), "health")
    answer = run.ask(asked, kind, {})
    show(output, answer, facts(answer.items()))


@with_options(ActiveRunOption)
def fault(
    run: ActiveRunOption,
    action: Literal["kill", "stop", "continue", "restart"] = Argument(
        metavar="ACTION", help="kill, stop, continue or restart."
    ),
    target: str = Argument(
        metavar="PROCESS", help="Number of an agent, agent1, ..., plant or coordinator."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    target = process_name(target)
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    show(output, answer, f"{action} {target}: done at tick {answer['tick']}")


@with_options(ActiveRunOption)
def target(
    run: ActiveRunOption,
    x: float | None = Argument(
        None, metavar="X", help="Position in the inertial frame, m: forwards."
    ),
    y: float | None = Argument(None, metavar="Y", help="To the right."),
    z: float | None = Argument(None, metavar="Z", help="Downwards."),
    speed: float | None = Option(
        None, metavar="MPS", min=1e-3, help="Largest speed; else up to 1 m/s, if feasible."
    ),
    file: Path | None = Option(
        None, metavar="CSV", help="Way points instead: columns x,y,z, or t,x,y,z without --speed."
    ),
    to: list[int] = Option(
        [],
        metavar="AGENT",
        min=1,
        help="Agent that is told, repeatable; the others learn it from plans.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Send the payload of an active run to a target.

    From the next tick on the reference leaves its path smoothly, also that to an earlier target,
    and comes to rest there. A target that cannot be flown is refused with the reason. Way points
    are run through on a smooth curve after the first one. With --to the target travels with plans,
    over the links of the run, from the agents that are told to the others.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport target 3 0 -12 --speed 1.5

    Example: transport target 3 0 -12 --to 2
    """
    coordinates = [value for value in (x, y, z) if value is not None]
    expected = 3 if file is None else 0
    if len(coordinates) != expected:
        also = "" if file is None else " and --file"
        fail(f"expected X Y Z, or --file, got {len(coordinates)} numbers{also}")

    given: dict[str, Any] = {"points_m": [coordinates]}
    if file is not None:
        with blame("--file"):
            given["points_m"], times_s = points_of(file)
        if times_s is not None:
            given["times_s"] = times_s
    if speed is not None:
        given["speed_mps"] = speed
    if to:
        given["to"] = to
    requested(TargetSection, given)  # refused here already, as in `set_links`

    answer = run.ask(COORDINATOR, "target", given)
    begin = f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)"
    reached = f"reached at t = {answer['reached_s']:.2f} s"
    end = f"the last way point at t = {answer['ends_s']:.2f} s"
    show(output, answer, f"{begin}, {reached}, {end}")


@with_options(ActiveRunOption)
def land(
    run: ActiveRunOption,
    x: float | None = Argument(
        None, metavar="X", help="Place in the inertial frame, m: forwards; else where it is."
    ),
    y: float | None = Argument(None, metavar="Y", help="To the right."),
    speed: float | None = Option(
        None, metavar="MPS", min=1e-3, help="Largest speed; else up to 0.5 m/s downwards."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Let the team of an active run come down, and rest.

    From the next tick on the reference leaves its path and leads down to the ground, where the payload
    is or at a place to which it goes first; targets of the scenario no longer hold. A landing that
    cannot be flown before the end of the run is refused with the reason.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport land 3 0
    """
    if (x is None) != (y is None):
        fail("expected X Y, or none of them, got 1 number")
    given: dict[str, Any] = {"land": True}
    if x is not None:
        given["land_at_m"] = [x, y]
    if speed is not None:
        given["speed_mps"] = speed
    answer = run.ask(COORDINATOR, "target", given)
    show(output, answer, _landing_in_words(answer))


def _landing_in_words(answer: Mapping[str, Any]) -> str:
    """Return when and where a landing begins and ends."""
    begin = f"landing from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)"
    x_m, y_m, z_m = answer["point_m"]
    return f"{begin}, at ({x_m:g}, {y_m:g}, {z_m:g}) m at t = {answer['ends_s']:.2f} s"


@with_options(ActiveRunOption)
def abort(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
    """Let a team of vehicles come down at once, as fast as it can.

    As `transport land` where it is, up to 2 m/s downwards; the run is aborted when it ends. The UAVs
    are on their rods until `transport release`, or the end of the run: no autopilot takes over before.
    Before the first tick the run ends at once. Outside of simulations time is left for it at any tick.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport abort
    """
    answer = run.ask(COORDINATOR, "abort", {})
    show(output, answer, _landing_in_words(answer))


@with_options(ActiveRunOption)
def release(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
    """End a run whose UAVs have landed and are off their rods.

    The run ends, and each autopilot holds its UAV, or lands it with `vehicles.at_end` land. Refused
    until the team is at rest after `transport land`, `transport abort`, or the end of the maneuver.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport release
    """
    answer = run.ask(COORDINATOR, "release", {})
    show(output, answer, f"released at tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


# A negative coordinate such as -2 is no option.
land.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]
target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]
