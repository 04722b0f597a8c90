"""Files of points, packed by hand: NumPy's, archives of them, and PCL's."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_with_header(header: str, body: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def npz(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return stream.getvalue()


def pcd(fields: str, sizes: str, types: str, points: int, encoding: str, body: bytes = b"", counts: str = "") -> bytes:
    lines = ["VERSION 0.7", f"FIELDS {fields}", f"SIZE {sizes}", f"TYPE {types}", f"COUNT {counts}" if counts else "#"]
    lines += [f"WIDTH {points}", "HEIGHT 1", f"POINTS {points}", f"DATA {encoding}", ""]
    return "\n".join(lines).encode() + body
