"""The nearest points of a cloud, by the k-d tree of small_gicp (Koide 2024, MIT), on one thread so that every call
gives the same bits."""

import importlib.util

import numpy as np
from numpy.typing import NDArray

from coec.errors import SourceError


def installed() -> bool:
    """Whether the optional extra is installed."""
    return importlib.util.find_spec("small_gicp") is not None


def require_installed() -> None:
    """Raises SourceError, which says what to install, if the optional extra is not installed."""
    if not installed():
        raise SourceError("LiDARs are registered with the optional extra `lidars`: pip install 'coec[lidars]'")


class KdTree:
    """Finite points (M, 3) in which the nearest ones can be looked up.

    Raises:
        SourceError: the optional extra is not installed.
    """

    def __init__(self, points_m: NDArray[np.float64]) -> None:
        require_installed()
        import small_gicp

        self._tree = small_gicp.KdTree(points_m, num_threads=1)

    def nearest(self, queries_m: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices (N, count) of the nearest points of each query (N, 3), nearest first, and squared distances
        (N, count) in m². The tree must hold at least `count` points."""
        if not len(queries_m):
            return np.empty((0, count), np.int64), np.empty((0, count))
        indices, squared = self._tree.batch_knn_search(queries_m, count, num_threads=1)
        return np.asarray(indices).astype(np.int64), np.asarray(squared, np.float64)
