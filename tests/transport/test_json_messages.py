"""Messages as JSON for other programs: every bit, and valid by the schemas of their channels."""

import dataclasses

import numpy as np
import orjson
import pytest
from hypothesis import given
from jsonschema import Draft202012Validator

from protocol.wire.codec import encode
from protocol.wire.messages import KINDS, Message
from tests.support.strategies import messages as any_message
from transport.report.json_messages import json_schema, to_json


@given(any_message)
def test_json_keeps_every_bit(message: Message) -> None:
    """A message rebuilt from its JSON is the same bit for bit, including signed zeros and empty arrays."""
    content = orjson.loads(to_json(message))
    values = {}
    for field in dataclasses.fields(message):
        value = content[field.name]
        if isinstance(getattr(message, field.name), np.ndarray):
            value = np.array(value, dtype=np.float64).reshape(content.get(f"{field.name}_shape", -1))
        values[field.name] = value
    assert encode(type(message)(**values)) == encode(message)


@given(any_message)
def test_messages_match_their_schema(message: Message) -> None:
    """Every JSON message is valid by the schema of its channel, so that viewers find the fields."""
    Draft202012Validator(json_schema(message.kind)).validate(orjson.loads(to_json(message)))


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_schemas_have_no_lists_of_lists(kind: str) -> None:
    """Every field is a number, a text or a flat list: viewers cannot plot nested lists."""
    schema = json_schema(kind)
    Draft202012Validator.check_schema(schema)
    for field in schema["properties"].values():
        assert field["type"] in {"string", "integer", "number", "boolean", "array"}
        assert field.get("items", {}).get("type") != "array"
