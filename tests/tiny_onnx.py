"""Networks of one or two operators, as the bytes of an ONNX file: packed by hand after onnx.proto (IR version
8), so that no test needs the `onnx` package or a stored binary.

A network takes `image`, 1×3×height×width float32, and gives `depth`, 1×1×height×width: the first colour
channel, or what the further operator makes of it.
"""

import struct
from collections.abc import Sequence

FLOAT, DOUBLE, INT64 = 1, 11, 7  # TensorProto.DataType
Dimension = int | str


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _value_info(name: str, element: int, shape: Sequence[Dimension]) -> bytes:
    dimensions = b"".join(_bytes(1, _number(1, each) if isinstance(each, int) else _bytes(2, each)) for each in shape)
    tensor = _number(1, element) + _bytes(2, dimensions)
    return _bytes(1, name) + _bytes(2, _bytes(1, tensor))


def _node(operator: str, inputs: Sequence[str], output: str, attributes: Sequence[bytes] = ()) -> bytes:
    names = b"".join(_bytes(1, each) for each in inputs)
    return names + _bytes(2, output) + _bytes(4, operator) + b"".join(_bytes(5, each) for each in attributes)


def _int_attribute(name: str, value: int) -> bytes:
    return _bytes(1, name) + _number(3, value) + _number(20, 2)


def first_channel_network(
    shape: Sequence[Dimension] = (1, 3, "h", "w"),
    *,
    then: str | None = None,
    element: int = FLOAT,
    input_name: str = "image",
    output_name: str = "depth",
    weights_file: str | None = None,
    second_output: bool = False,
) -> bytes:
    """The ONNX file of a network that gives the first colour channel of its input.

    Args:
        shape: of the input; a string is a free dimension of that name.
        then: operator of one input that the channel goes through, for example `Sqrt`.
        element: type of the input's elements.
        input_name, output_name: of the tensors.
        weights_file: where the one weight (an int64 zero) lies outside of this file; None keeps it inside.
        second_output: also give the whole input, as `copy`.
    """
    gathered = "channel" if then else output_name
    nodes = [_node("Gather", [input_name, "index"], gathered, [_int_attribute("axis", 1)])]
    if then:
        nodes.append(_node(then, [gathered], output_name))
    if second_output:
        nodes.append(_node("Identity", [input_name], "copy"))
    index = _number(1, 1) + _number(2, INT64) + _bytes(8, "index")
    if weights_file is None:
        index += _bytes(9, struct.pack("<q", 0))
    else:
        location = _bytes(1, "location") + _bytes(2, weights_file)
        length = _bytes(1, "length") + _bytes(2, "8")
        index += _bytes(13, location) + _bytes(13, length) + _number(14, 1)
    graph = b"".join(_bytes(1, node) for node in nodes) + _bytes(2, "tiny") + _bytes(5, index)
    graph += _bytes(11, _value_info(input_name, element, shape))
    graph += _bytes(12, _value_info(output_name, element, [shape[0], 1, *shape[2:]]))
    if second_output:
        graph += _bytes(12, _value_info("copy", element, shape))
    return _number(1, 8) + _bytes(7, graph) + _bytes(8, _bytes(1, "") + _number(2, 13))


MODEL_CARD = """
name: tiny
input: {name: image, size: {side: 32, multiple: 16, fit: short}, scale: 1.0}
output: {name: depth, kind: inverse_depth}
licence: CC0-1.0
source: tests
"""
"""A model card that fits `first_channel()`."""
