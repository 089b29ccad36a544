"""The commands `transport experiment ...`. Heavy imports are inside, as in all of the command line."""

import inspect
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.wire.exit_codes import EXIT_CASE_FAILED, EXIT_SCENARIO
from transport.experiments.errors import ExperimentError, refused

if TYPE_CHECKING:
    from protocol.scenario.schema import Scenario
    from transport.experiments.experiment import Experiment
    from transport.experiments.simulation import Result
    from transport.experiments.sweep import Simulate

_INTERRUPTED = 130

# With --quick: a maneuver of 1.5 s, and an agent that is killed and started again within it.
_QUICK = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
_HOVERING = ("paper", "centralized", "resilient", "centralized_lq", "precise")
_QUICK_HOVER = (
    "maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
    "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
)
_QUICK_SEEDS = 2

# What most experiments run unless told otherwise.
_USUAL = ("paper", "resilient")

# What teams of all sizes fly: the paper's speed, 0.5 m/s, in 10 s instead of 25.
_SHORTENED = (
    "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
    "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]"
)

experiment_app = typer.Typer(
    help="Fly many variations of a scenario and compare them.\n\nTables, confidence intervals, a figure.",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Exit codes: 0 done, whatever was found; 2 usage, 3 scenario, 4 cluster or worker lost, "
    "7 some flights could not be flown, 130 interrupted.",
)

ScenariosOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scenario",
        help="Scenario file or name; by default paper and resilient, in hover centralized as well. Repeatable.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a value of every scenario. Repeatable."),
]
SeedsOption = Annotated[
    int | None, typer.Option("--seeds", min=1, help="Repetitions of what is random, with the seeds 0, 1, ...")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder; one of the same experiment is gone on with. By default a new one in runs/."),
]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Flights at a time; as many as there are cores by default.")
]
DaskOption = Annotated[
    str | None, typer.Option("--dask", metavar="ADDRESS", help="Fly on a Dask cluster, e.g. tcp://host:8786.")
]
ProcessesOption = Annotated[
    bool, typer.Option("--processes", help="Fly each as `transport run` does, recorded, one after the other.")
]
QuickOption = Annotated[bool, typer.Option("--quick", help="Short flights and few of them: a trial, no measurement.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Options:
    """What all experiments can be told."""

    settings: list[str] | None
    seeds: int
    out: Path | None
    jobs: int | None
    quick: bool
    scenarios: list[str] | None = None
    dask: str | None = None
    processes: bool = False
    maneuver: str = ""
    quick_maneuver: str = _QUICK
    usual_scenarios: tuple[str, ...] = _USUAL

    def named(self) -> list[str]:
        """Scenarios to fly."""
        return self.scenarios or list(self.usual_scenarios)

    def read(self) -> "dict[str, Scenario]":
        """Scenarios to fly, by name, with the changes of every scenario.

        Raises: ExperimentError: one is named twice. ScenarioError: one that cannot be.
        """
        from protocol.scenario.file import find_scenario, read_scenario

        names = self.named()
        if len(set(names)) < len(names):
            raise refused("--scenario", "each value once", ", ".join(names))
        return {name: read_scenario(find_scenario(name), self.changes()) for name in names}

    def changes(self) -> list[str]:
        """Changes of every scenario, the experiment's own maneuver first."""
        maneuver = self.quick_maneuver if self.quick else self.maneuver
        return [*([maneuver] if maneuver else []), *(self.settings or [])]


def _sweep(
    *, usual_seeds: int, usual_scenarios: tuple[str, ...] = _USUAL, quick_maneuver: str = _QUICK
) -> Callable[[Callable[..., "Experiment"]], None]:
    """Make a command of a function that says what to fly: with its own options, and those that all sweeps have.

    Args:
        usual_seeds: Repetitions without `--seeds`.
        usual_scenarios: Scenarios without `--scenario`.
        quick_maneuver: Setting of the maneuver with `--quick`.
    """

    def shared_options(
        scenarios: ScenariosOption = None,
        settings: SetOption = None,
        seeds: SeedsOption = None,
        out: OutOption = None,
        jobs: JobsOption = None,
        dask: DaskOption = None,
        processes: ProcessesOption = False,
        quick: QuickOption = False,
    ) -> _Options:
        return _Options(
            settings=settings,
            seeds=_seeds(seeds, usual_seeds, quick=quick),
            out=out,
            jobs=jobs,
            quick=quick,
            scenarios=scenarios,
            dask=dask,
            processes=processes,
            quick_maneuver=quick_maneuver,
            usual_scenarios=usual_scenarios,
        )

    def command_of(build: Callable[..., "Experiment"]) -> None:
        _, *own = inspect.signature(build).parameters.values()
        shared = inspect.signature(shared_options).parameters

        def command(**given: Any) -> None:
            options = shared_options(**{name: given.pop(name) for name in shared})
            _conduct(lambda: _fly(build(options, **given), options))

        # What the command line reads.
        parameters = [*own, *shared.values()]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        command.__doc__ = build.__doc__
        experiment_app.command(build.__name__)(command)

    return command_of


@_sweep(usual_seeds=1)
def latency(
    shared: _Options,
    delays: Annotated[
        list[float] | None, typer.Option("--delay", help="Delay of every plan, s; by default 0 to 0.4. Repeatable.")
    ] = None,
) -> "Experiment":
    """How late plans may be: a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    from transport.experiments import network_sweeps

    return network_sweeps.latency(
        shared.named(), delays or ([0.0, 0.2] if shared.quick else [0.0, 0.05, 0.1, 0.2, 0.4])
    )


@_sweep(usual_seeds=5)
def loss(
    shared: _Options,
    shares: Annotated[
        list[float] | None, typer.Option("--loss", help="Share of lost plans; by default 0.1, 0.3, 0.6. Repeatable.")
    ] = None,
    burst: Annotated[float, typer.Option("--burst", help="Mean length of a burst, ticks.")] = 5.0,
) -> "Experiment":
    """How many plans may be lost: on their own, as many in bursts."""
    from transport.experiments import network_sweeps

    return network_sweeps.loss(shared.named(), shares or ([0.3] if shared.quick else [0.1, 0.3, 0.6]), burst)


@_sweep(usual_seeds=3)
def jitter(
    shared: _Options,
    distributions: Annotated[
        list[str] | None,
        typer.Option("--distribution", help="uniform, normal, exponential, lognormal; by default all. Repeatable."),
    ] = None,
    deviations: Annotated[
        list[float] | None,
        typer.Option("--std", help="Standard deviation of the delay, s; by default 0.02, 0.05, 0.08. Repeatable."),
    ] = None,
    mean: Annotated[float, typer.Option("--mean", help="Mean delay, s.")] = 0.16,
) -> "Experiment":
    """How irregular delays may be.

    Several distributions of the same mean and standard deviation.
    """
    from transport.experiments import network_sweeps

    chosen = distributions or (["uniform", "exponential"] if shared.quick else list(network_sweeps.JITTER))
    return network_sweeps.jitter(
        shared.named(), chosen, deviations or ([0.05] if shared.quick else [0.02, 0.05, 0.08]), mean
    )


@_sweep(usual_seeds=1)
def kill(
    shared: _Options,
    at: Annotated[float | None, typer.Option("--at", help="When the agent is killed, s; by default 8.")] = None,
    restart: Annotated[
        float | None, typer.Option("--restart", help="When it is started again, s; by default 10.")
    ] = None,
) -> "Experiment":
    """What an agent's death does.

    Each in turn is killed, and started again or not; the others fly on.
    """
    from transport.experiments import agent_failures

    agents = {name: len(scenario.owned) for name, scenario in shared.read().items()}
    usual = (0.5, 1.0) if shared.quick else (8.0, 10.0)
    kill_s, restart_s = (then if given is None else given for given, then in zip((at, restart), usual, strict=True))
    return agent_failures.kill(agents, kill_s, restart_s)


@_sweep(usual_seeds=1, usual_scenarios=("resilient",))
def deaths(
    shared: _Options,
    count: Annotated[int | None, typer.Option("--count", min=1, help="Deaths of each scenario; by default 20.")] = None,
    draw: Annotated[int, typer.Option("--draw", min=0, help="Seed of the times and of who is killed.")] = 0,
) -> "Experiment":
    """Random agents killed for good at random times.

    Each run kills one agent and never restarts it; the others fly on.

    Example: transport experiment deaths --processes
    """
    from transport.experiments import agent_failures

    return agent_failures.deaths(shared.read(), count or (2 if shared.quick else 20), draw)


@_sweep(usual_seeds=3)
def matrix(
    shared: _Options,
    delays: Annotated[
        list[float] | None,
        typer.Option("--delay", help="Delay of every plan, s; by default 0, 0.1, 0.2, 0.4. Repeatable."),
    ] = None,
    shares: Annotated[
        list[float] | None, typer.Option("--loss", help="Share of lost plans; by default 0, 0.1, 0.3, 0.6. Repeatable.")
    ] = None,
) -> "Experiment":
    """Delay and loss together, as a map for each algorithm.

    Of cost and survival.
    """
    from transport.experiments import network_sweeps

    delays_s = delays or ([0.0, 0.2] if shared.quick else [0.0, 0.1, 0.2, 0.4])
    return network_sweeps.matrix(
        shared.named(), delays_s, shares or ([0.0, 0.3] if shared.quick else [0.0, 0.1, 0.3, 0.6])
    )


@_sweep(usual_seeds=3)
def ablation(
    shared: _Options,
) -> "Experiment":
    """What each part of the algorithm is worth.

    One setting changed at a time, on a perfect network and on one that is late and lossy.
    """
    from transport.experiments.ablation import ablation

    return ablation(shared.read())


@_sweep(usual_seeds=1)
def horizon(
    shared: _Options,
    horizons: Annotated[
        list[int] | None, typer.Option("--horizon", help="N_p, steps; by default 5, 10, 20, 30. Repeatable.")
    ] = None,
    terminals: Annotated[
        list[float] | None,
        typer.Option("--terminal", help="Terminal weight, for open-loop prediction; by default 1, 5, 20. Repeatable."),
    ] = None,
    delay: Annotated[float, typer.Option("--delay", help="Delay of every plan on the second network, s.")] = 0.2,
) -> "Experiment":
    """Effect of prediction horizon and terminal weight.

    Each horizon with each weight, on a perfect network and with a delay.

    Example: transport experiment horizon --horizon 10 --horizon 20 --scenario paper
    """
    from transport.experiments import tuning

    quick = shared.quick
    steps, weights = (
        horizons or ([10] if quick else [5, 10, 20, 30]),
        terminals or ([5.0] if quick else [1.0, 5.0, 20.0]),
    )
    return tuning.horizon(shared.read(), steps, weights, delay)


@_sweep(usual_seeds=1, usual_scenarios=_HOVERING, quick_maneuver=_QUICK_HOVER)
def hover(
    shared: _Options,
    durations: Annotated[
        list[float] | None,
        typer.Option(
            "--duration",
            help="Duration of the last phase, s; by default 5, 20, 65. Repeatable.",
        ),
    ] = None,
) -> "Experiment":
    """Stability in a long hover after the maneuver.

    The last phase lasts longer, all else stays.

    Example: transport experiment hover --duration 60 --scenario resilient
    """
    from transport.experiments import tuning

    return tuning.hover(shared.read(), durations or ([0.5, 1.0] if shared.quick else [5.0, 20.0, 65.0]))


@_sweep(usual_seeds=5)
def sharing(
    shared: _Options,
    thresholds: Annotated[
        list[float] | None,
        typer.Option(
            "--threshold", help="Change from which on a plan is sent, share of the input's range. Repeatable."
        ),
    ] = None,
    heartbeat: Annotated[float, typer.Option("--heartbeat", help="A plan is sent at least that often, s.")] = 1.0,
) -> "Experiment":
    """How few plans have to be sent to the other agents.

    Messages against cost, on a perfect network and on one with 200 ms delay and 30 % loss.

    Flies resilient unless told otherwise: agents need the shared law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    from transport.experiments import network_sweeps

    usual = [0.01] if shared.quick else [0.002, 0.005, 0.01, 0.02, 0.05]
    return network_sweeps.sharing(shared.scenarios or ["resilient"], thresholds or usual, heartbeat)


@experiment_app.command()
def paper(
    gust: Annotated[
        float, typer.Option("--gust", help="Standard deviation of the wind's gusts, m/s; 0 for still air alone.")
    ] = 1.0,
    settings: SetOption = None,
    seeds: Annotated[int | None, typer.Option("--seeds", min=1, help="Flights of each controller in gusts.")] = None,
    out: OutOption = None,
    jobs: JobsOption = None,
    quick: QuickOption = False,
) -> None:
    """The paper's claim: centralized against distributed control.

    Both run at a grid of sampling periods: mean cost over processor time, which is measured first.

    Ends with a table, figures, and a verdict with its spread at the same rate and at the same computation.

    Example: transport experiment paper --seeds 10
    """
    options = _Options(settings=settings, seeds=_seeds(seeds, 5, quick=quick), out=out, jobs=jobs, quick=quick)
    _conduct(lambda: _compare(gust, options))


@experiment_app.command()
def scaling(
    largest: Annotated[
        int | None, typer.Option("--max", help="UAVs of the largest team, 2 to 16; by default 12.")
    ] = None,
    settings: SetOption = None,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="Flights of each team; repetitions tell how sure the timing is.")
    ] = 1,
    out: OutOption = None,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", min=1, help="Flights at a time; 1, as timing is measured, which flights side by side disturb."
        ),
    ] = 1,
    quick: QuickOption = False,
) -> None:
    """How cost, computation and messages grow with the team.

    Teams of 2 to 12 UAVs made of `resilient`, each with an agent for every UAV, every pair, and one for all.

    Computation is processor time, measured in the same flights.

    Costs and messages do not depend on --jobs, timing does.
    """
    options = _Options(settings=settings, seeds=seeds, out=out, jobs=jobs, quick=quick, maneuver=_SHORTENED)

    def build() -> "Experiment":
        from transport.experiments import scaling

        sizes, usual = (scaling.QUICK_SIZES, 6) if quick else (scaling.SIZES, 12)
        return scaling.scaling("resilient", usual if largest is None else largest, sizes)

    _conduct(lambda: _fly(build(), options))


def _seeds(given: int | None, usual: int, *, quick: bool) -> int:
    return given if given is not None else min(usual, _QUICK_SEEDS) if quick else usual


def _conduct(experiment: Callable[[], None]) -> None:
    """Fly an experiment, and end with its exit code."""
    from protocol.scenario.file import ScenarioError

    code = 0
    try:
        with _terminated_like_interrupted():
            experiment()
    except ExperimentError as error:
        typer.echo(f"transport: {error}", err=True)
        code = error.exit_code
    except ScenarioError as error:
        typer.echo(f"transport: {error}", err=True)
        code = EXIT_SCENARIO
    except KeyboardInterrupt:
        typer.echo("transport: interrupted", err=True)
        code = _INTERRUPTED
    raise typer.Exit(code)


def _fly(experiment: "Experiment", options: _Options) -> None:
    from rich.console import Console

    from transport.experiments.cases import cases_of
    from transport.experiments.conclusions import conclusions
    from transport.experiments.results import Results
    from transport.experiments.scaling import scaling_conclusions
    from transport.experiments.sweep import report, sweep
    from transport.experiments.table import WIDTH, WIDTH_OF_VARIANTS, table_of
    from transport.flight.run import machine

    _check(options)
    folder = _folder(options, experiment.name)
    cases = cases_of(experiment.points, options.changes(), options.seeds, timed=experiment.timed)
    console = Console(stderr=True)
    trial = "trial, no measurement" if options.quick else ""
    if trial:
        console.print(f"--quick: a {trial}", highlight=False)
    with Results(folder, experiment.name, machine()) as results:
        for notice in results.notices:
            console.print(notice, highlight=False, soft_wrap=True)
        done = sum(results.done(case.key) for case in cases)
        if done:
            console.print(f"{done} of {len(cases)} flights are done already", highlight=False)
        found = sweep(experiment, cases, _way(options, folder), results, console)
        measured, files = report(experiment, cases, found, folder)
    title = f"{experiment.name}: means of completed flights, ± 95 % confidence" + (f" ({trial})" if trial else "")
    if experiment.timed:
        phases = cases[0].scenario.maneuver.phase  # the same for all
        title += f"\n{sum(phase.duration_s for phase in phases):g} s of {', '.join(phase.name for phase in phases)}"
    output = Console()
    output.width = max(output.width, WIDTH_OF_VARIANTS if experiment.drawn_as == "variants" else WIDTH)
    output.print(table_of(title, measured, timed=experiment.timed))
    sentences = scaling_conclusions(measured) if experiment.timed else conclusions(measured)
    lines = ["", *sentences, "", f"machine: {machine()}", *(f" {path}" for path in files)]
    sys.stdout.write("\n".join(lines) + "\n")
    _check_flown(found)


def _compare(gust_mps: float, options: _Options) -> None:
    """The paper's comparison, which measures processor time besides."""
    from rich.console import Console

    from transport.experiments import comparison, comparison_report

    if not 0.0 <= gust_mps < math.inf:
        raise refused("--gust", "a speed >= 0 m/s", f"{gust_mps:g}")
    folder, console = _folder(options, comparison.NAME), Console(stderr=True)
    trial = "trial, no measurement" if options.quick else ""
    if trial:
        console.print(f"--quick: a {trial}", highlight=False)
    simulate = _way(options, folder)
    lines, table, found = comparison_report.compare(
        options.changes(), options.seeds, gust_mps, folder, simulate, console, quick=options.quick
    )
    output = Console()
    output.width = max(output.width, comparison_report.WIDTH)
    output.print(table)
    sys.stdout.write("\n".join(lines) + "\n")
    _check_flown(found)


def _folder(options: _Options, name: str) -> Path:
    from datetime import UTC, datetime

    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    return options.out or Path("runs") / f"experiment-{name}-{stamp}"


def _check_flown(found: "Sequence[Result]") -> None:
    """Say so, after everything else, if a flight could not be flown."""
    failed = [result for result in found if result.outcome == "error"]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise ExperimentError(f"a flight could not be flown{more}: {failed[0].reason}", EXIT_CASE_FAILED)


def _check(options: _Options) -> None:
    """Refuse ways of flying that cannot be."""
    given = {"--processes": options.processes, "--dask": options.dask is not None, "--jobs": options.jobs is not None}
    chosen = [name for name, is_given in given.items() if is_given]
    if len(chosen) > 1:
        raise refused(chosen[0], "no other of --processes, --dask, --jobs", f"{chosen[1]} as well")
    if options.dask is not None:
        from transport.experiments.workers import check_cluster

        check_cluster(options.dask)


def _way(options: _Options, folder: Path) -> "Simulate":
    """How the cases are flown."""
    import joblib

    from transport.experiments import simulation, workers

    if options.dask is not None:
        address = options.dask
        return lambda cases: workers.on_cluster(cases, address)
    if options.processes:
        return lambda cases: (simulation.simulate_in_processes(case, folder / "runs") for case in cases)
    jobs = options.jobs or joblib.cpu_count()
    return lambda cases: workers.on_cores(cases, min(jobs, len(cases)))


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
