"""Short tracebacks: an error that the user can solve ends at the public function that the user called."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

from protocol.wire.errors import TransportError

F = TypeVar("F", bound=Callable[..., Any])


def public(function: F) -> F:
    """Return a public function whose `TransportError`s show the user's own frames and that of the function, no others.

    The errors of libraries that they came from are left out: the text of a `TransportError` says all of it. Other
    exceptions are bugs and keep their whole traceback.
    """

    @wraps(function)
    def with_short_traceback(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except TransportError as error:
            error.__cause__, error.__suppress_context__ = None, True
            own = error.__traceback__ and error.__traceback__.tb_next  # the first is the frame of this function
            if own is not None:
                own.tb_next = None
                error.__traceback__ = own
            raise

    return cast("F", with_short_traceback)
