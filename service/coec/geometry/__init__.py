"""Arrays in, arrays out: rigid transforms, camera models and compiled kernels. NumPy and numba only."""

from pkgutil import iter_modules

_SHARED = frozenset({"base", "double_sphere_fit", "registry"})
"""Modules of `coec.geometry.cameras` that are no camera models."""

_ORDER = ("pinhole", "radtan", "rational", "kannala_brandt", "mei", "eucm", "double_sphere")
"""Models that lists and schemas name first, from narrow lenses to wide ones; all others follow."""

CAMERA_MODELS = tuple(
    sorted(
        (
            module.name
            for module in iter_modules([f"{folder}/cameras" for folder in __path__])
            if module.name not in _SHARED
        ),
        key=lambda name: _ORDER.index(name) if name in _ORDER else len(_ORDER),
    )
)
"""Names of the camera models: each is a module of `coec.geometry.cameras`. They are known before any is imported, for
the configuration, which loads no NumPy."""
