"""Correlation of signals on two spheres at all rotations between them, by a Fourier transform on the rotation group
(Kostelec, Rockmore 2008, "FFTs on the rotation group").

For e on the sphere of a camera and p on the sphere of a LiDAR, with spherical harmonics e_lm and p_lm,

    Σ_i p_i·e(R·d_i) = Σ_mm' exp(i·m·α)·exp(i·m'·γ) Σ_l d^l_mm'(β)·e_lm·conj(p_lm'),   R = R_z(α)·R_y(β)·R_z(γ).

Bandwidth B takes B⁴ operations for B³ rotations. One by one, each rotation would take as many as there are points.
"""

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange

Complexes = NDArray[np.complex128]


class RotationGrid:
    """Cells of a sphere, and the rotations at which two signals are correlated, for one bandwidth B.

    The sphere has 2·B rows (from the z axis down) of 4·B columns. There are 2·B values of each Euler angle.
    """

    def __init__(self, bandwidth: int) -> None:
        self.bandwidth = bandwidth
        self._rows, self._columns = 2 * bandwidth, 4 * bandwidth
        self._polar_rad = (np.arange(self._rows) + 0.5) * math.pi / self._rows

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """(N, 3) unit vectors to the centres of the cells."""
        azimuth = np.tile(np.arange(self._columns) * math.tau / self._columns, self._rows)
        polar = np.repeat(self._polar_rad, self._columns)
        sine = np.sin(polar)
        return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)], axis=1)

    @cached_property
    def solid_angles(self) -> NDArray[np.float64]:
        """(N,) steradians."""
        of_row = np.sin(self._polar_rad) * (math.pi / self._rows) * (math.tau / self._columns)
        return np.repeat(of_row, self._columns)

    def cells(self, xyz: NDArray[np.floating]) -> NDArray[np.int64]:
        """(n,) the cell in whose direction each of n points (n, 3) lies."""
        x, y, z = xyz.T.astype(np.float64)
        row = np.floor(np.arctan2(np.hypot(x, y), z) * (self._rows / math.pi)).astype(np.int64)
        column = np.rint(np.arctan2(y, x) * (self._columns / math.tau)).astype(np.int64) % self._columns
        return np.asarray(np.minimum(row, self._rows - 1) * self._columns + column)

    def harmonics(self, values: NDArray[np.float64]) -> Complexes:
        """(B, F, B) by m ≥ 0, signal and l: harmonics of F real signals, given by the integral (F, N) over each
        cell."""
        of_rows = np.fft.rfft(values.reshape(-1, self._rows, self._columns), axis=2)
        harmonics = np.zeros((self.bandwidth, len(values), self.bandwidth), np.complex128)
        for m, legendre in enumerate(self._legendre):
            harmonics[m, :, m:] = np.einsum("fj,lj->fl", of_rows[:, :, m], legendre[m:])
        return harmonics

    @cached_property
    def _legendre(self) -> NDArray[np.float64]:
        """(B, B, 2·B) by m, l and row: orthonormal associated Legendre functions."""
        b, cosine, sine = self.bandwidth, np.cos(self._polar_rad), np.sin(self._polar_rad)
        legendre = np.zeros((b, b, self._rows))
        diagonal = np.full(self._rows, math.sqrt(0.25 / math.pi))
        for m in range(b):
            if m > 0:
                diagonal = -math.sqrt((2 * m + 1) / (2 * m)) * sine * diagonal
            legendre[m, m] = diagonal
            if m + 1 < b:
                legendre[m, m + 1] = math.sqrt(2 * m + 3) * cosine * diagonal
            for degree in range(m + 2, b):
                ahead = math.sqrt((4 * degree**2 - 1) / (degree**2 - m**2))
                back = math.sqrt(((degree - 1) ** 2 - m**2) / (4 * (degree - 1) ** 2 - 1))
                legendre[m, degree] = ahead * (cosine * legendre[m, degree - 1] - back * legendre[m, degree - 2])
        return legendre

    def correlation(self, of_camera: Complexes, of_lidar: Complexes) -> NDArray[np.float32]:
        """(2·B, 2·B, 2·B) by β, α and γ: the sum over F signals of their correlation at every rotation, from their
        harmonics (b, F, b) up to a bandwidth b ≤ B."""
        b, side = len(of_camera), 2 * self.bandwidth
        # m' < 0 of a real signal: the conjugate of m' > 0, with alternating sign.
        sign = (-1.0) ** np.arange(b - 1, 0, -1)[:, None, None]
        whole = np.concatenate([sign * np.conj(of_lidar[:0:-1]), of_lidar])
        sums = _wigner_sums(of_camera, np.conj(whole), np.cos(self._polar_rad))
        correlation = np.empty((side, side, side), np.float32)
        spectrum = np.zeros((side, side // 2 + 1), np.complex64)
        for row in range(side):
            spectrum[:b, :b] = sums[:, b - 1 :, row].T
            spectrum[side - b + 1 :, :b] = sums[:, : b - 1, row].T
            correlation[row] = np.fft.irfft2(spectrum, s=(side, side), norm="forward").T
        return correlation

    def rotations(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 3, 3) R_camera_lidar at flat places (n,) of a correlation."""
        side = 2 * self.bandwidth
        row, first, last = np.unravel_index(index, (side, side, side))
        of_first, of_last = (_about_z(place.astype(np.float64) * (math.tau / side)) for place in (first, last))
        return np.asarray(np.einsum("nij,njk,nkl->nil", of_first, _about_y(self._polar_rad[row]), of_last))


def _about_z(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros(len(angle_rad)), np.ones(len(angle_rad))
    return np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), 2, 0)


def _about_y(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros(len(angle_rad)), np.ones(len(angle_rad))
    return np.moveaxis(np.array([[c, zero, s], [zero, one, zero], [-s, zero, c]]), 2, 0)


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _wigner_sums(of_camera: Complexes, of_lidar: Complexes, cosine: NDArray[np.float64]) -> NDArray[np.complex64]:
    """(B, 2·B - 1, J) by m ≥ 0, m' and β: Σ_l d^l_mm'(β)·C_l, with C_l the sum over the signals of the products of
    their harmonics (B, F, B) and (2·B - 1, F, B)."""
    bandwidth, signals, rows = of_camera.shape[0], of_camera.shape[1], cosine.shape[0]
    width = 2 * bandwidth - 1
    sums = np.empty((bandwidth, width, rows), np.complex64)
    for pair in prange(bandwidth * width):
        m, column = pair // width, pair % width
        n = column - (bandwidth - 1)
        real, imaginary = np.zeros(rows), np.zeros(rows)
        previous, here = np.zeros(rows), np.empty(rows)
        _first_wigner(m, n, cosine, here)
        for degree in range(max(m, abs(n)), bandwidth):
            product = 0.0j
            for f in range(signals):
                product += of_camera[m, f, degree] * of_lidar[column, f, degree]
            of_real, of_imaginary = product.real, product.imag
            # Three-term recursion in the degree (Kostelec, Rockmore 2008, equation 2.11 without its norm).
            below, above = float(degree), degree + 1.0
            root = math.sqrt((above * above - m * m) * (above * above - n * n))
            ahead, middle, back = above * (2.0 * below + 1.0) / root, 0.0, 0.0
            if degree > 0:
                middle = (2.0 * below + 1.0) * m * n / (below * root)
                back = above / below * math.sqrt((below * below - m * m) * (below * below - n * n)) / root
            for j in range(rows):
                d = here[j]
                real[j] += d * of_real
                imaginary[j] += d * of_imaginary
                here[j] = (ahead * cosine[j] - middle) * d - back * previous[j]
                previous[j] = d
        for j in range(rows):
            sums[m, column, j] = np.complex64(complex(real[j], imaginary[j]))
    return sums


@njit(cache=True, error_model="numpy")
def _first_wigner(m: int, n: int, cosine: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """d^l_mn at the least degree l that has it, max(|m|, |n|), for m ≥ 0."""
    degree = max(m, abs(n))
    if degree == m:
        other, sign = n, -1.0 if (m - n) % 2 else 1.0
    elif n > 0:
        other, sign = m, 1.0
    else:
        other, sign = -m, -1.0 if (degree + m) % 2 else 1.0
    norm = 0.5 * (math.lgamma(2 * degree + 1.0) - math.lgamma(degree + other + 1.0) - math.lgamma(degree - other + 1.0))
    for j in range(cosine.shape[0]):
        # The rows are the centres of cells, so that neither logarithm is of zero.
        along, across = math.log(0.5 * (1.0 + cosine[j])), math.log(0.5 * (1.0 - cosine[j]))
        out[j] = sign * math.exp(norm + 0.5 * (degree + other) * along + 0.5 * (degree - other) * across)


@njit(cache=True)
def local_maxima(scores: NDArray[np.float32], least: float) -> NDArray[np.int64]:
    """Flat places of the values (β, α, γ) above `least` that are no lower than their six neighbours; α and γ wrap."""
    rows, side, _ = scores.shape
    maxima = []
    for row in range(rows):
        for a in range(side):
            for g in range(side):
                value = scores[row, a, g]
                if (
                    value > least
                    and value >= scores[row, a - 1, g]
                    and value >= scores[row, (a + 1) % side, g]
                    and value >= scores[row, a, g - 1]
                    and value >= scores[row, a, (g + 1) % side]
                    and value >= scores[max(row - 1, 0), a, g]
                    and value >= scores[min(row + 1, rows - 1), a, g]
                ):
                    maxima.append((row * side + a) * side + g)
    return np.array(maxima, np.int64) if len(maxima) > 0 else np.empty(0, np.int64)
