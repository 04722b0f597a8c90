"""Draws a picture of where a refused camera model is off."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coec.errors import LensError
from coec.geometry.cameras import Camera
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere


@contextmanager
def drawn_if_refused(folder: Path | None, camera: Camera) -> Iterator[None]:
    """If a fit to the camera is refused within, draws into the folder where the fit is off, and says where the picture
    is.

    Raises:
        LensError: the one from within, plus the path of the picture; without a folder, plus how to get a picture.
        OutputError: the picture cannot be written.
    """
    try:
        yield
    except LensError as error:
        if folder is None:
            raise LensError(
                f"{error}; with --output DIR a picture shows where in the image it is off", error.details
            ) from error
        # matplotlib takes a second to import.
        from coec.reports import pictures

        drawn = pictures.write_lens(folder, camera, fit_double_sphere(camera).camera)
        told = {**error.details, "picture": str(drawn)}
        raise LensError(f"{error}. Where in the image it is off: {drawn}", told) from error
