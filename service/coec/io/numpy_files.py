"""Arrays of `.npy` and `.npz` files, read with bounds."""

import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from coec.errors import SourceError
from coec.io import user_files


def read_npy(path: Path) -> NDArray[np.generic]:
    """The array of a `.npy` file, memory-mapped, so that the size in its header is checked against the length of the
    file.

    Raises:
        SourceError: the file is absent, not a `.npy` file, truncated or too large.
    """
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError as error:
        raise SourceError(f"{path} does not exist") from error
    except Exception as error:  # NumPy parses the header as Python source, and raises whatever such a parser may
        raise SourceError(f"{path} is not a NumPy array, or is truncated: {_error_text(error)}") from error
    if array.nbytes > user_files.MAX_FILE_BYTES:
        raise SourceError(
            f"{path} has more than {user_files.MAX_FILE_BYTES} bytes: too large for a single file of a recording"
        )
    return array


def read_npz(path: Path, names: Collection[str]) -> dict[str, NDArray[np.generic]]:
    """The arrays of these names that a `.npz` file has.

    Raises:
        SourceError: the file is absent, not a `.npz` file or damaged, or the arrays are too large unpacked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {item.filename: item for item in archive.infolist()}
            selected = {name: members[f"{name}.npy"] for name in names if f"{name}.npy" in members}
            unpacked = sum(item.file_size for item in selected.values())
            if unpacked > user_files.MAX_FILE_BYTES:
                raise SourceError(f"{path} would unpack to {unpacked} bytes: refused")
            return {name: _npz_member(archive, item) for name, item in selected.items()}
    except (FileNotFoundError, SourceError) as error:
        raise SourceError(f"{path} does not exist" if isinstance(error, OSError) else str(error)) from error
    except Exception as error:  # zip, zlib and NumPy's header parser each raise more than they document
        raise SourceError(f"{path} is not an .npz file, or is damaged: {_error_text(error)}") from error


def _npz_member(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> NDArray[np.generic]:
    with archive.open(item) as stream:
        shape, _, dtype = _npy_header(stream)
        if shape and (min(shape) < 0 or max(shape) > user_files.MAX_FILE_BYTES):
            raise ValueError("its shape is invalid")
        if int(np.prod(shape, dtype=object)) * dtype.itemsize > item.file_size:
            raise ValueError("it promises more than the archive holds")
    with archive.open(item) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    match np.lib.format.read_magic(stream):
        case (1, 0):
            return np.lib.format.read_array_header_1_0(stream)
        case _:
            return np.lib.format.read_array_header_2_0(stream)


def _error_text(error: Exception) -> str:
    """The text of an error in one short line, because some errors quote the whole file."""
    return f"{type(error).__name__}: {str(error).splitlines()[0][:120]}" if str(error) else type(error).__name__
