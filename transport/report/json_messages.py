"""Messages as JSON and the JSON Schema of each kind, both from the fields of the message classes.

A matrix is written row by row with its shape in a second field (`inputs`, `inputs_shape`): viewers plot `inputs[0]`,
but few plot a list of lists. A float64 is written with the fewest digits that read back as the same bits.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args, get_origin, get_type_hints

import orjson
from mcap.writer import Writer

from model.arrays import Array
from protocol.wire.messages import KINDS, Message

# Array fields with two axes; all others have one.
_MATRICES = ("uav_states", "inputs", "corrections")

_FIELDS: dict[str, dict[str, Any]] = {
    kind: {field.name: get_type_hints(cls)[field.name] for field in dataclasses.fields(cls)}
    for kind, cls in KINDS.items()
}

_SCALARS = {str: "string", int: "integer", float: "number", bool: "boolean"}


def to_json(message: Message) -> bytes:
    """Return a message as a JSON object."""
    content: dict[str, Any] = {}
    for name in _FIELDS[message.kind]:
        value = getattr(message, name)
        if name in _MATRICES:
            content[name], content[_shape_of(name)] = value.reshape(-1), value.shape
        else:
            content[name] = value
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of message, for viewers."""
    properties: dict[str, Any] = {}
    for name, hint in _FIELDS[kind].items():
        properties[name] = _type(hint)
        if name in _MATRICES:
            properties[_shape_of(name)] = {"type": "array", "items": {"type": "integer"}}
    cls = KINDS[kind]
    return {
        "title": cls.__name__,
        "description": (cls.__doc__ or "").split("\n", 1)[0],
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }


class JsonChannels:
    """Channels and schemas of one MCAP writer, registered on first use."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def number(self, topic: str, name: str, schema: Callable[[], dict[str, Any]]) -> int:
        """Return the channel number of a topic, whose messages have the JSON Schema of a name."""
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", orjson.dumps(schema()))
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])
        return self._channels[topic]

    def of_message(self, topic: str, kind: str) -> int:
        """Return the channel number of a topic with messages of one kind."""
        return self.number(topic, f"transport.{KINDS[kind].__name__}", partial(json_schema, kind))


def _shape_of(name: str) -> str:
    return f"{name}_shape"


def _type(hint: Any) -> dict[str, Any]:
    if hint == Array:
        return {"type": "array", "items": {"type": "number"}}
    if get_origin(hint) is Literal:
        return {"type": "string", "enum": list(get_args(hint))}
    if get_origin(hint) is tuple:
        return {"type": "array", "items": _type(get_args(hint)[0])}
    return {"type": _SCALARS[hint]}
