"""The command `transport router`."""

import signal
import threading
from typing import Annotated

from typer import Option

from protocol.network.endpoints import Endpoints, refuse_exposed, security_of
from protocol.network.journal import Journal
from protocol.network.security import SecurityError
from protocol.network.session import BusError, route
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNREACHABLE
from protocol.wire.keys import ROUTER
from transport.cli.options import ScenarioOption, SetOption
from transport.cli.output import exit_on
from transport.cli.scenario_setup import read_setup


def router(
    listen: Annotated[
        list[str], Option("--listen", metavar="ENDPOINT", help="Zenoh endpoint to listen on. Repeatable.")
    ],
    connect: Annotated[
        list[str] | None, Option("--connect", metavar="ENDPOINT", help="Endpoint of another router.")
    ] = None,
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
) -> None:
    """Route messages between hosts without a direct connection.

    Serves any run until Ctrl-C. The scenario says which processes take part, and with which keys.

    Example: transport router --listen tcp/127.0.0.1:7400
    """
    setup = read_setup(scenario, settings, allow_large=True)
    security = security_of(setup.scenario)
    endpoints = Endpoints(listen=listen, connect=connect or [], mode="router", security=security)
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    journal = Journal("any", ROUTER)
    with exit_on(SecurityError, code=EXIT_SCENARIO), exit_on(BusError, code=EXIT_UNREACHABLE):
        refuse_exposed(endpoints, setup.scenario)
        if security is not None:
            security.check(ROUTER, mode="router")
        with route(endpoints):
            journal.log("listening", at=", ".join(listen))
            over.wait()
    journal.log("finished")
