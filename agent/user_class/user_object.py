"""One object of the user's class and the calls of its methods, each failure in one line."""

from collections.abc import Callable, Sequence
from typing import Any

from transport.agent.user_class.returned_values import Outcome, checked, converted
from transport.agent.user_class.run_for_user import Run
from transport.protocol.scenario.user_class.user_errors import errors_of, new_object
from transport.protocol.scenario.user_class.user_import import own_class
from transport.protocol.wire.messages import Measurement, Plan

METHODS = ("start", "step", "stop")  # of a class of the user
NEGOTIATING = (*METHODS, "negotiate")  # with several exchanges within a tick


class OwnObject:
    """An object of a class "package.module:Class", started for a run.

    Raises: OwnClassError: it cannot be made or started.
    """

    def __init__(self, name: str, run: Run, *, is_negotiating: bool) -> None:
        self._run = run
        self._object: Any = new_object(own_class(name), NEGOTIATING if is_negotiating else METHODS)
        with errors_of("start"):
            self._object.start(run)
        run.started()

    def step(self, measurement: Measurement, plans: Sequence[Plan]) -> Outcome:
        """Return the result of a step, checked. Raises: OwnClassError: it fails."""
        return self._result("step", lambda: self._object.step(measurement, plans))

    def negotiate(self, iteration: int, proposals: Sequence[Plan]) -> Outcome:
        """Return the result of an exchange, checked. Raises: OwnClassError: it fails."""
        return self._result("negotiate", lambda: self._object.negotiate(iteration, proposals))

    def _result(self, method: str, call: Callable[[], object]) -> Outcome:
        with errors_of(method):
            returned = call()

        def wording(_: str, words: str) -> str:
            return f"{method}: expected arrays of real numbers, got {type(returned).__name__} ({words})"

        with errors_of(method, wording):
            result = converted(returned, method, self._run.data_shape)
        return checked(result, method, self._run)

    def stop(self) -> None:
        """End the run for the class. Raises: OwnClassError: that fails."""
        with errors_of("stop"):
            self._object.stop()
