"""Opening bundles: each of their messages is checked as if it had come alone."""

from collections import deque

from protocol.admission.admission import Admission
from protocol.wire.keys import Keys
from protocol.wire.messages import Bundle, Message, MessageError


class Unbundling:
    """The messages of a bundle that are for one process, read one after the other.

    Attributes:
        bundle: The bundle whose messages are being read, or None.
        data: Bytes of the message that `next` returned last.
    """

    def __init__(self, name: str, keys: Keys, admission: Admission) -> None:
        self.bundle: Bundle | None = None
        self.data = b""
        self._keys, self._admission = keys, admission
        subscriptions = [keys.end(key) for key in keys.subscriptions(name)]
        self._subscribed = {key for key in subscriptions if not key.endswith("/*")}
        self._subscribed_below = {key.removesuffix("/*") for key in subscriptions if key.endswith("/*")}
        self._own = [keys.end(key) for key in keys.publications(name)]
        self._parts: deque[tuple[str, bytes]] = deque()  # keys and messages still to be read

    def open(self, bundle: Bundle) -> None:
        """Begin to read a bundle."""
        self.bundle = bundle
        for end, data in zip(bundle.keys, bundle.parts, strict=True):
            key = f"{self._keys.prefix}/{end}"
            if not bundle.may_carry(end):
                text = f"{bundle.kind} of {bundle.sender} with a message under the key {end}"
                self._admission.refuse(key, MessageError("wrong_sender", text, bundle.sender))
            elif end not in self._own and self._is_subscribed(end):
                self._parts.append((key, data))

    def _is_subscribed(self, end: str) -> bool:
        head, _, last = end.rpartition("/")
        return end in self._subscribed or (head in self._subscribed_below and bool(last))

    def next(self) -> Message | None:
        """Return the next message of the bundle; None when all are read."""
        while self._parts:
            key, self.data = self._parts.popleft()
            message = self._admission.read(key, self.data, self.bundle)
            if message is not None:
                return message
        self.bundle = None
        return None
