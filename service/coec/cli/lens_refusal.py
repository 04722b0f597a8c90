"""A camera model that is refused leaves a picture of what it misses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coec.errors import LensError
from coec.geometry.cameras import Camera
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere
from coec.reports import pictures


@contextmanager
def drawn_if_refused(folder: Path | None, camera: Camera) -> Iterator[None]:
    """Draws into the folder what a fit to the camera misses, should it be refused within, and says where that is.

    Raises:
        LensError: the one from within, with the place of the picture; where there is no folder, how to have one.
        OutputError: the picture cannot be written.
    """
    try:
        yield
    except LensError as error:
        if folder is None:
            raise LensError(
                f"{error}; with --output DIR a picture shows where in the image it is off", error.details
            ) from error
        drawn = pictures.write_lens(folder, camera, fit_double_sphere(camera).camera)
        told = {**error.details, "picture": str(drawn)}
        raise LensError(f"{error}. Where in the image it is off: {drawn}", told) from error
