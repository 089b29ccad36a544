"""Process of the fork server: the imports, the model and the control law of a run, done once for all its processes."""

import itertools
import socket
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NoReturn

from transport.cli.lazy import load
from transport.cli.options import process_setup
from transport.flight.fork_server import serve
from transport.protocol.network.node_process import use_one_thread
from transport.protocol.network.parent_and_environment import wake_with_its_end
from transport.protocol.scenario.setup.run_setup import Setup

if TYPE_CHECKING:
    from transport.mpc.law.present_law import Regulation


class Prepared:
    """Model and control law of a run, computed once: the processes forked after share their memory.

    The fork server calls `prepare` before each fork. The law's results are shared as long as it is
    kept: `model.digests_and_shared_results`.
    """

    def __init__(self) -> None:
        self.setup: Setup | None = None
        self.law: Regulation | None = None

    def prepare(self, arguments: Sequence[str]) -> None:
        """Take in the arguments of a process of the run, which `transport run` has checked."""
        from transport.mpc.law.present_law import Regulation

        scenario = arguments[arguments.index("--scenario") + 1]
        settings = [value for option, value in itertools.pairwise(arguments) if option == "--set"]
        setup = process_setup(scenario, settings, allow_large=True)
        # `read_setup` returns the same object as long as scenario, settings and file are the same; a
        # changed file is another setup, of which the law is computed again.
        if setup is self.setup:
            return
        self.setup = setup
        if setup.scenario.has_vehicles:
            from transport.protocol.network.mavlink import messages

            messages()  # half a second of import, which a vehicle that returns would fly without
        self.law = Regulation(setup.model, setup.hover, setup.settings, setup.reference.sampled)
        self.law.fail_safe.warm_up()


def serve_processes(requests: socket.socket, command: Callable[[], NoReturn]) -> None:
    """Be the fork server (`transport.flight.fork_server`): fork processes that run the command."""
    wake_with_its_end()
    import_processes()
    serve(requests, Prepared().prepare, command)


def import_processes() -> None:
    """Do once what agent, plant and coordinator do first, for the processes that are forked later."""
    load("transport.cli.streams")
    commands = load("transport.cli.main").command()
    for role in ("agent", "coordinator", "plant"):
        load(f"transport.{role}.node")
        commands.load(role).build_parsers()
    load("transport.flight.roles")
    use_one_thread()
