"""Metadata of the laboratory's wheel that depend on the version: it needs exactly the coec of the same checkout."""

from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LIBRARIES = ("embreex>=4.4", "matplotlib>=3.9", "numba>=0.61", "numpy>=2.0", "pydantic>=2.12", "rich>=14.3")
"""What the laboratory imports itself. embreex is Intel's Embree, the ray casting of the simulated vehicle."""


class Dependencies(MetadataHookInterface):
    """Writes the requirements."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Adds them to the metadata of the project."""
        metadata["dependencies"] = [f"coec[fleet]=={metadata['version']}", *LIBRARIES]
