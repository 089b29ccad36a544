"""The commands about scenarios: `transport scenario new` and `transport validate`."""

import math
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tomli_w
import typer
from typer import Option

from protocol.scenario.budget import check_budget, estimate
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import FEWEST, MOST, given, read_vehicle, resized
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.options import FormatOption, LargeOption, ScenarioArgument, SetOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup, scenario_errors
from transport.flight.header import checked

# Number of UAVs beyond which a user should know that the model takes long to build.
_LONG = 48


def new(
    uavs: Annotated[int, Option("--uavs", metavar="COUNT", help="Number of UAVs, 2 to 256.")],
    template: Annotated[
        str, Option("--from", metavar="SCENARIO", help="Scenario file or name for all but the system.")
    ] = "resilient",
    group: Annotated[
        int | None, Option("--groups", metavar="COUNT", help="UAVs per agent; by default as in --from.")
    ] = None,
    vehicle: Annotated[
        str | None,
        Option("--vehicle", metavar="NAME", help="crazyflie, x500, racing or a vehicle file; default: the paper's."),
    ] = None,
    load_kg: Annotated[
        float | None, Option("--load", metavar="KG", help="Payload mass; by default half the mass of the UAVs.")
    ] = None,
    name: Annotated[
        str | None, Option("--name", metavar="NAME", help="Name; by default from --from, --vehicle and --uavs.")
    ] = None,
    out: Annotated[
        Path | None, Option("--out", metavar="FILE", help="File to write; by default standard output.")
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Write a scenario for a team of any size.

    UAVs in a ring. By default they are the paper's, 0.5 m apart, with 0.75 kg of payload for each. A vehicle brings its
    mass, inertia, rod, limits, motors and inner loop: docs/vehicles.md.

    Example: transport scenario new --uavs 4 --vehicle x500 --load 3.0 --out four.toml
    """
    if not FEWEST <= uavs <= MOST:
        why = ": a payload on one rod rotates freely about it, and no input can control that" if uavs == 1 else ""
        fail(f"--uavs: expected {FEWEST} to {MOST}, got {uavs}{why}", EXIT_USAGE)
    if group is not None and not 1 <= group <= uavs:
        fail(f"--groups: expected 1 to {uavs} UAVs per agent, got {group}", EXIT_USAGE)
    if load_kg is not None and not 0.0 < load_kg < math.inf:
        fail(f"--load: expected a number > 0 kg, got {load_kg}", EXIT_USAGE)
    if vehicle is not None:
        with exit_on(ScenarioError, code=EXIT_SCENARIO, option="--vehicle"):
            read_vehicle(vehicle)
    if out is not None and out.exists():
        fail(f"--out: expected a file that does not exist yet, got {out}", EXIT_USAGE)
    with exit_on(ScenarioError, code=EXIT_SCENARIO, option="--from"):
        path = find_scenario(template)
        ready = read_scenario(path, allow_large=True)
    source = f"--from {template}"
    if uavs > _LONG:
        typer.echo(f"checking the model of {uavs} UAVs: this takes minutes", err=True)
    try:
        scenario = resized(
            ready, path.parent, uavs, group=group, name=name, source=source, vehicle=vehicle, load_kg=load_kg
        )
        setup = Setup.of(scenario, source)
    except ScenarioError as error:
        if error.field == "name":
            fail(f"--name: {error.problem}", EXIT_USAGE)
        fail(str(error), EXIT_SCENARIO)
    made_by = ["transport", "scenario", "new", "--uavs", str(uavs), "--from", template]
    made_by += [] if group is None else ["--groups", str(group)]
    made_by += [] if vehicle is None else ["--vehicle", vehicle]
    made_by += [] if load_kg is None else ["--load", f"{load_kg:g}"]
    made_by += [] if name is None else ["--name", name]
    comment = [
        f"Made by: {shlex.join(made_by)}",
        f"{uavs} UAVs in a ring over a payload that fits; all but [system], owned and name is from {ready.name}.",
        *([f"Mass, inertia, rods, limits, inner loop and motors are from the vehicle {vehicle}."] if vehicle else []),
    ]
    text = scenario_text(given(scenario), comment)
    if output is Format.json:
        show_json({"scenario": given(scenario), "file": None if out is None else str(out)})
    elif out is None:
        typer.echo(text, nl=False)
    if out is None:
        return
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        fail(f"--out: cannot write {out} ({error.strerror})", EXIT_USAGE)
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, hover thrust {setup.hover.u[0]:.2f} N"
    large = "" if _is_within_limits(scenario) else " --allow-large"
    typer.echo(f"{sizes}; run it with: transport run {shlex.quote(str(out))}{large}", err=True)


def _is_within_limits(scenario: Scenario) -> bool:
    """Return whether a run of the scenario is accepted without --allow-large."""
    try:
        check_budget(scenario, "")
    except ScenarioError:
        return False
    return True


def validate(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check a scenario and print it with every default.

    Prints an estimate of memory, log size and processor time on standard error.

    Example: transport validate paper --set controller.horizon=10
    """
    setup = read_setup(scenario, settings, allow_large=large)
    with scenario_errors(settings):
        classes = checked(setup)
    doubts = list(setup.doubts())
    if output is Format.json:
        show_json({"scenario": setup.scenario.tree(), "digest": setup.scenario.digest(), "warnings": doubts})
        return
    typer.echo(tomli_w.dumps(setup.scenario.tree()), nl=False)
    for doubt in doubts:
        typer.echo(f"warning: {doubt}", err=True)
    hover = ", ".join(f"{thrust:.2f}" for thrust in setup.hover.u[::4])
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    about = f"{sizes}, hover thrust {hover} N, digest {setup.scenario.digest()}"
    own = ", ".join(f"{what} {name}" for what, name in classes.items() if name != "mpc")
    typer.echo(f"valid: {about}, {own}", err=True)
    typer.echo(f"estimate: {estimate(setup.scenario).text()}", err=True)


def scenario_text(tree: dict[str, Any], comment: Sequence[str]) -> str:
    """Return a scenario in TOML.

    Args:
        tree: The scenario as plain data; its keys are bare words.
        comment: Lines for the top; TOML forbids most unprintable characters, so each becomes a question mark.
    """
    top = ["# " + "".join(c if c.isprintable() else "?" for c in line) for line in comment]
    return "\n".join([*top, *_table(tree, ""), ""])


def _table(tree: dict[str, Any], path: str) -> Iterator[str]:
    """Yield the lines of a table: its values first, as everything after a heading belongs to that heading."""
    tables: list[tuple[str, str, dict[str, Any]]] = []
    for key, value in tree.items():
        name = path + key
        if isinstance(value, dict):
            tables.append((f"[{name}]", name, value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            tables += [(f"[[{name}]]", name, entry) for entry in value]
        else:
            yield f"{key} = {_value(value)}"
    for heading, name, table in tables:
        yield from ("", heading)
        yield from _table(table, f"{name}.")


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return tomli_w.dumps({"_": value}).removeprefix("_ = ").rstrip("\n")
