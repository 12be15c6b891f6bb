"""
Flights as cosine coefficients of blocks, whitened by the noise of each frequency band.

A flight is cut into blocks, and each block of each channel is transformed by an orthonormal DCT.
Coefficients of one band share a covariance over the channels, which are the noise of this flight.
A sample that does not count is zero in the residual and in its slopes, so the linear model stays
exact. The covariance is a maximum of the marginal likelihood (expectation maximisation): the
squared residual of a fit of everything plus the variance of that fit, so that a flexible fit does
not make the noise look small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

BLOCK = 8.0         # [s] of a block: longer than the memory of a flight controller
EDGES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)    # [Hz] of the bands; the first is the mean alone
LEAST = 0.25         # share of a block that must count


@dataclass(eq=False)
class Spectrum:
    """
    Cosine coefficients of one flight.

    Attributes:
        residual: (B, F, C) coefficients of the residual in B blocks at F frequencies.
        slopes: (B, F, C, K) those of the slopes.
        band: (F,) band of each frequency.
        noise: (bands, C, C) covariance of the coefficients of each band.
        floor: (C,) smallest standard deviation of a sample's noise.

    """

    residual: np.ndarray
    slopes: np.ndarray
    band: np.ndarray
    noise: np.ndarray
    floor: np.ndarray
    _kept: tuple | None = None

    def grams(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Normal equations of each block and band.

        Returns:
            (B, bands, K, K) information and (B, bands, K) right sides, so that the least squares
            solution is information^-1 right.

        """
        if self._kept is None:
            self._kept = self._grams()
        return self._kept

    def power(self) -> float:
        """Sum of squares of the whitened residual."""
        inverse = np.linalg.inv(self.noise)[self.band]
        return float(np.einsum('bfc,fcd,bfd->', self.residual, inverse, self.residual))

    def _grams(self):
        blocks, _, _, count = self.slopes.shape
        bands = len(self.noise)
        info, right = np.zeros((blocks, bands, count, count)), np.zeros((blocks, bands, count))
        for k in range(bands):
            own = self.band == k
            root = np.linalg.inv(np.linalg.cholesky(self.noise[k]))
            s = np.einsum('cd,bfdk->bfck', root, self.slopes[:, own])
            r = self.residual[:, own] @ root.T
            s, r = s.reshape(blocks, -1, count), r.reshape(blocks, -1)
            info[:, k] = s.transpose(0, 2, 1) @ s
            right[:, k] = -(s.transpose(0, 2, 1) @ r[..., None])[..., 0]
        return info, right

    def learn(self, x: np.ndarray, covariance: np.ndarray, prior: np.ndarray,
              weight: float) -> None:
        """
        One pass of expectation maximisation of the noise.

        Args:
            x: (K,) fitted keys of this flight.
            covariance: (K, K) their covariance.
            prior: (bands, C, C) noise of all flights together.
            weight: number of coefficients as which this prior counts.

        """
        self._kept = None
        left = self.residual + self.slopes @ x
        spread = self.slopes @ covariance
        for k in range(len(self.noise)):
            own = self.band == k
            e, w, j = (part[:, own].reshape(-1, *part.shape[2:])
                       for part in (left, spread, self.slopes))
            total = e.T @ e + np.einsum('nck,ndk->cd', w, j, optimize=True)
            self.noise[k] = (total + weight * prior[k]) / (len(e) + weight) \
                + np.diag(self.floor**2)


def blocks_of(mask: np.ndarray, period: float) -> np.ndarray:
    """(B, n) samples of the blocks in which enough samples of ``mask`` (N, C) count."""
    there = np.flatnonzero(mask.any(axis=1))
    if not len(there):
        return np.zeros((0, 0), dtype=int)
    length = there[-1] + 1 - there[0]
    count = max(int(length * period / BLOCK), 1)
    rows = there[0] + np.arange(count * (length // count)).reshape(count, -1)
    return rows[mask[rows].any(axis=2).mean(axis=1) >= LEAST]


def spectrum(residual: np.ndarray, slopes: np.ndarray, mask: np.ndarray, period: float,
             floor: np.ndarray, highest: float) -> Spectrum:
    """
    Cosine coefficients of a flight that has blocks.

    Args:
        residual: (N, C) measured minus expected.
        slopes: (N, C, K) its derivatives.
        mask: (N, C) samples that count.
        period: of the samples [s].
        floor: (C,) smallest standard deviation of a sample's noise.
        highest: largest frequency that counts [Hz].

    """
    rows = blocks_of(mask, period)
    weight, size = mask[rows], rows.shape[1]
    frequency = np.arange(size) / (2 * size * period)
    used = frequency <= min(EDGES[-1], highest)
    coefficients = dct(residual[rows] * weight, axis=1, norm='ortho')[:, used]
    derivatives = dct(slopes[rows] * weight[..., None], axis=1, norm='ortho')[:, used]
    band = np.searchsorted(EDGES, frequency[used], side='left')
    noise = np.tile(np.diag(floor.astype(float)**2), (len(EDGES), 1, 1))
    for k in np.unique(band):
        own = coefficients[:, band == k].reshape(-1, coefficients.shape[2])
        noise[k] += np.diag((own**2).mean(axis=0))
    return Spectrum(coefficients, derivatives, band, noise, floor)


def pooled(spectra: list[Spectrum]) -> np.ndarray:
    """(bands, C, C) mean noise of flights with the same channels."""
    return np.mean([s.noise for s in spectra], axis=0)
