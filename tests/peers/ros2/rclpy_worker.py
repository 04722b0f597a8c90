"""In ROS 2's own environment: reads and writes messages as a node does. A request and an answer a line, in JSON.

{"do": "read", "type": "sensor_msgs/msg/Image", "cdr": "<hexadecimal>"}   -> {"fields": {...}}
{"do": "write", "type": "sensor_msgs/msg/Image", "fields": {...}}         -> {"cdr": "<hexadecimal>"}
{"do": "hash", "type": "sensor_msgs/msg/Image"}                           -> {"hash": "RIHS01_..."}
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message


def type_of(name: str) -> Any:
    package, _, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), message)


def plain(value: Any) -> Any:
    """A message as JSON values; bytes and numbers of arrays as lists of numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, str):
        return value
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(item) for item in value] if hasattr(value, "__len__") else value


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """The inverse of `plain`."""
    for name, kind in message.get_fields_and_field_types().items():
        value = fields[name]
        inner = kind.removeprefix("sequence<").split(">")[0].split("[")[0]
        if kind in ("octet", "byte"):
            value = bytes(value)
        elif "/" in inner:
            module, _, message_name = inner.rpartition("/")
            make = type_of(f"{module}/msg/{message_name}")
            value = [fill(make(), one) for one in value] if kind != inner else fill(make(), value)
        setattr(message, name, value)
    return message


def answer(request: dict[str, Any]) -> dict[str, Any]:
    kind = type_of(request["type"])
    if request["do"] == "read":
        return {"fields": plain(deserialize_message(bytes.fromhex(request["cdr"]), kind))}
    if request["do"] == "write":
        return {"cdr": serialize_message(fill(kind(), request["fields"])).hex()}
    description = Path(sys.prefix, "share", f"{request['type']}.json").read_text()
    (result,) = (item for item in json.loads(description)["type_hashes"] if item["type_name"] == request["type"])
    return {"hash": result["hash_string"]}


for line in sys.stdin:
    try:
        reported = answer(json.loads(line))
    except Exception as error:
        reported = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(reported), flush=True)
