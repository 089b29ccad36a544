"""Errors of a deployment."""

from transport.protocol.wire.errors import TransportError


class DeployError(TransportError, ValueError):
    """An inventory, keys or folders that cannot be used.

    The text has file or option, expected and got.
    """
