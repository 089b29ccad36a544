"""Channels of a log: one for each network key, one for what the recorder says itself."""

from mcap.records import Channel

from protocol.wire.codec import VERSION
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import LinkChange, Message, Plan, Target

# Name of the metadata record that describes the run.
METADATA = "run"
# Encoding of the bytes of messages (docs/protocol.md); a log of another version of the protocol has another.
ENCODING = f"payload-transport/{VERSION}"
# Beginning of the channels of messages that the recorder made; no message from the network can be there.
OWN = f"/{RECORDER}/"

KEYS = Keys("log")


def is_known(channel: Channel) -> bool:
    """Return whether this version reads a channel."""
    return channel.message_encoding == ENCODING


def channel_of(message: Message) -> str:
    """Return the channel in which a message is in the log if it came alone."""
    return OWN + message.kind if message.sender == RECORDER else KEYS.of(message).removeprefix(KEYS.prefix)


def topic_of(message: Message) -> str:
    """Return the channel of a message in descriptions and exports; each kind has its own, in bundles or not."""
    match message:
        case LinkChange() | Target():  # share the key of the rosters
            return f"/{message.kind}"
        case Plan(agent=agent):  # has two keys
            return f"/{message.kind}/{agent}"
    return KEYS.of(message).removeprefix(KEYS.prefix)


def kind_of(topic: str) -> str:
    """Return the message kind of a channel of `topic_of`."""
    return topic.lstrip("/").split("/", 1)[0]
