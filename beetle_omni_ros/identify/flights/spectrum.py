"""
Flights as cosine coefficients of blocks, of residuals that a causal filter has whitened.

A flight is cut into blocks, and each block of each channel is transformed by an orthonormal DCT.
First, each band of frequency has a covariance of the channels. It is a maximum of the marginal
likelihood (expectation maximisation): the squared residual of a fit of everything plus the
variance of that fit, so that a flexible fit does not make the noise look small. The filters
follow from it. The filtered coefficients of all bands then share one covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct
from scipy.signal import fftconvolve

BLOCK = 8.0         # [s] of a block: longer than the memory of a flight controller
# [Hz] of the bands; the first is the mean alone
EDGES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 25.0)
MANY = 4            # times as many coefficients as keys: the variance of the fit is negligible
WARM = 0.5          # [s] after a gap of this length that do not count
TAPS = 1.0          # [s] length of a whitening filter
NONE = np.zeros(0, dtype=int)
LEAST = 0.25         # share of a block that must count


@dataclass(eq=False)
class Linear:
    """
    A flight linearised at a point.

    Attributes:
        residual: (N, C) measured minus expected at the point.
        slopes: (N, C, K) derivatives by the keys.

    """

    residual: np.ndarray
    slopes: np.ndarray


@dataclass(eq=False)
class Spectrum:
    """
    Cosine coefficients of one flight.

    Attributes:
        residual: (B, F, C) coefficients of the residual in B blocks at F frequencies.
        parts: groups of channels with common noise: their indices (c,), the keys (k,) that act on
            them, and slopes (B, F, c, k) by these.
        keys: number of all keys.
        band: (F,) band of each frequency.
        noise: (bands, C, C) covariance of the coefficients of each band.
        floor: (C,) smallest standard deviation of a sample's noise.
        counts: number of frequencies that count, of each group.
        step: between frequencies, the first of which is zero [Hz].
        level: whether all bands have the same noise.
        hidden: bands and channels that do not count, because noise hides the motion.
        balanced: bands and channels in which most keys have no slope; see :meth:`forget`.

    """

    residual: np.ndarray
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    keys: int
    band: np.ndarray
    noise: np.ndarray
    floor: np.ndarray
    counts: list[int]
    step: float
    level: bool = False
    hidden: Sequence[tuple[int, list[int]]] = ()
    balanced: Sequence[tuple[int, list[int]]] = ()

    def at(self, x: np.ndarray) -> np.ndarray:
        """(B, F, C) coefficients of the residual at deviations ``x`` (K,)."""
        result = self.residual.copy()
        for channels, keys, slopes in self.parts:
            result[..., channels] += slopes @ x[keys]
        return result

    def by(self, key: int) -> np.ndarray:
        """(B, F, C) coefficients of the slopes by one key."""
        result = np.zeros(self.residual.shape)
        for channels, keys, slopes in self.parts:
            result[..., channels] = slopes[..., keys == key].sum(axis=3)
        return result

    def forget(self, keys: list[int], bands: list[tuple[int, list[int]]], at: np.ndarray) -> None:
        """Hold these keys at their values in ``at`` (K,), in some bands and channels."""
        self.balanced = bands
        for channels, own, slopes in self.parts:
            for band, lost in bands:
                rows = np.flatnonzero(self.band[:slopes.shape[1]] == band)
                gone = np.isin(channels, lost)[:, None] & np.isin(own, keys)
                self.residual[:, rows[:, None], channels] += (slopes[:, rows] * gone) @ at[own]
                slopes[:, rows] *= ~gone

    def joined(self, copies: list[tuple[int, int, list[int]]], other: Spectrum, count: int
               ) -> Spectrum:
        """
        This one with further keys.

        Args:
            copies: index of a key, that of the key that it acts as, and on which channels.
            other: spectrum of the same flight.
            count: index at which the keys of ``other`` begin.

        """
        parts = []
        for (channels, keys, slopes), (_, more, further) in zip(
                self.parts, other.parts, strict=True):
            own = [(k, slopes[..., keys == key] * np.isin(channels, rows)[:, None])
                   for k, key, rows in copies if key in keys]
            parts.append((channels, np.concatenate([
                keys, np.array([k for k, _ in own], dtype=int), count + more]), np.concatenate(
                [slopes, *(part for _, part in own), further], axis=3)))
        return replace(self, parts=parts, keys=count + other.keys)

    def grams(self, groups: np.ndarray = NONE) -> tuple[np.ndarray, np.ndarray]:
        """
        Normal equations of each block and group of bands.

        Args:
            groups: (bands,) group of each band, from 0, ascending; none: all are one group.

        Returns:
            (B, groups, K, K) information and (B, groups, K) right sides, so that the least squares
            solution is information^-1 right.

        """
        blocks, copies = len(self.residual), int(groups.max(initial=0)) + 1
        info = np.zeros((blocks, copies, self.keys, self.keys))
        right = np.zeros((blocks, copies, self.keys))
        for (channels, keys, slopes), most in zip(self.parts, self.counts, strict=True):
            s, r = np.zeros((blocks, most, *slopes.shape[2:])), np.zeros(
                (blocks, most, len(channels)))
            for k, own in enumerate(self._bands(most)):
                lost = [c for band, hidden in self.hidden if band == k for c in hidden]
                seen, root = np.flatnonzero(~np.isin(channels, lost)), np.zeros(s.shape[2:3] * 2)
                noise = self.noise[k][np.ix_(channels[seen], channels[seen])]
                root[np.ix_(seen, seen)] = np.linalg.inv(np.linalg.cholesky(noise))
                np.matmul(root, slopes[:, own], out=s[:, own])
                r[:, own] = self.residual[:, own][..., channels] @ root.T
            edges = np.searchsorted(groups[self.band[:most]] if len(groups) else np.zeros(most),
                                    np.arange(copies + 1))
            for block in range(blocks):
                for group, (low, high) in enumerate(zip(edges, edges[1:], strict=False)):
                    rows = s[block, low:high].reshape((high - low) * len(channels), len(keys))
                    info[block, group, keys[:, None], keys] += rows.T @ rows
                    right[block, group, keys] -= rows.T @ r[block, low:high].ravel()
        return info, right

    def power(self) -> float:
        """Sum of squares of the whitened residual."""
        total = 0.0
        for (channels, _, _), count in zip(self.parts, self.counts, strict=True):
            own = self.residual[:, :count][..., channels]
            inverse = np.linalg.inv(self.noise[:, channels[:, None], channels])
            total += np.einsum('bfc,fcd,bfd->', own, inverse[self.band[:count]], own)
        return float(total)

    @property
    def size(self) -> int:
        """Number of coefficients that count."""
        return len(self.residual) * sum(count * len(part[0]) for part, count in zip(
            self.parts, self.counts, strict=True))

    def _bands(self, count):
        """Range of frequencies of each band, of the first ``count`` frequencies."""
        edges = np.minimum(np.searchsorted(self.band, np.arange(len(self.noise) + 1)), count)
        return [slice(a, b) for a, b in zip(edges, edges[1:], strict=False)]

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
        for (channels, keys, slopes), most in zip(self.parts, self.counts, strict=True):
            of_keys = covariance[np.ix_(keys, keys)]
            totals, counts = [], []
            for own in self._bands(most):
                j, e = slopes[:, own], self.residual[:, own][..., channels]
                count = e.shape[0] * e.shape[1]
                j = j.reshape(count, len(channels), len(keys))
                e = e.reshape(count, len(channels)) + j @ x[keys]
                total = e.T @ e
                if len(j) < MANY * len(keys):
                    w = (j.reshape(-1, len(keys)) @ of_keys).reshape(j.shape)
                    total = total + (w @ j.transpose(0, 2, 1)).sum(axis=0)
                totals.append(total)
                counts.append(len(j))
            if self.level:
                totals, counts = [sum(totals)] * len(totals), [sum(counts)] * len(counts)
            for k, (total, size) in enumerate(zip(totals, counts, strict=True)):
                at = np.ix_(channels, channels)
                self.noise[k][at] = (total + weight * prior[k][at]) / (size + weight) \
                    + np.diag(self.floor[channels]**2)


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
             floor: np.ndarray, highest: np.ndarray | float, groups: list[np.ndarray],
             filters: np.ndarray | None = None) -> Spectrum:
    """
    Cosine coefficients of a flight that has blocks.

    Args:
        residual: (N, C) measured minus expected.
        slopes: (N, C, K) its derivatives.
        mask: (N, C) samples that count.
        period: of the samples [s].
        floor: (C,) smallest standard deviation of a sample's noise.
        highest: largest frequency that counts [Hz], of all channels or (C,), one value a group.
        groups: indices of the channels with common noise.
        filters: (C, L) whitening filters; None: the noise differs between bands.

    """
    weight = mask if filters is None else warm(mask, period)
    rows = blocks_of(weight, period)
    weight, size = weight[rows], rows.shape[1]
    frequency = np.arange(size) / (2 * size * period)
    highest = np.broadcast_to(highest, len(floor))
    used = frequency <= min(EDGES[-1], highest.max())
    coefficients = np.zeros((len(rows), int(used.sum()), len(floor)))
    parts = []
    acts = (slopes != 0).any(axis=0)    # most keys act on few channels
    for channels in groups:
        keys = np.flatnonzero(acts[channels].any(axis=0))
        made = np.zeros((*coefficients.shape[:2], len(channels), len(keys)))
        for k, c in enumerate(channels):
            own = np.flatnonzero(acts[c, keys])
            both = np.column_stack([residual[:, c], slopes[:, c, keys[own]]])
            if filters is not None:
                both = _whitened(both, np.flatnonzero(mask[:, c]), filters[c])
            both = dct(both[rows] * weight[:, :, c, None], axis=1, norm='ortho')[:, used]
            coefficients[:, :, c], made[:, :, k, own] = both[..., 0], both[..., 1:]
        parts.append((channels, keys, made))
    band = np.searchsorted(EDGES, frequency[used], side='left')
    noise = np.tile(np.diag(floor.astype(float)**2), (len(EDGES), 1, 1))
    for k in np.unique(band):
        there = coefficients[:, band == k].reshape(-1, coefficients.shape[2])
        noise[k] += np.diag((there**2).mean(axis=0))
    counts = [int((frequency[used] <= highest[channels[0]]).sum()) for channels in groups]
    return Spectrum(coefficients, parts, slopes.shape[2], band, noise, floor, counts,
                    0.5 / (size * period), filters is not None)


def warm(mask: np.ndarray, period: float) -> np.ndarray:
    """(N, C) samples of filtered channels that count."""
    return np.stack([_known(own, int(WARM / period)) for own in mask.T], axis=1)


def _known(mask, warm):
    """(N,) samples that count of a filtered channel: not those after the begin or a long gap."""
    there = np.flatnonzero(mask)
    gap = np.convolve(~mask, np.ones(warm))[:len(mask)] >= warm
    lost = np.convolve(gap, np.ones(warm + 1))[:len(mask)] > 0
    lost[:there[0] + warm if len(there) else None] = True
    return mask & ~lost


def _whitened(series, there, kernel):
    """
    Series (N, n) of one channel, filtered; samples that are not ``there`` are interpolated.

    Residual and slopes are treated alike, so that the linear model stays exact.
    """
    if not len(there):
        return series
    t = np.arange(len(series))
    right = np.clip(np.searchsorted(there, t), 0, len(there) - 1)
    left = np.clip(np.searchsorted(there, t, side='right') - 1, 0, None)
    left, right = there[left], there[right]
    part = np.clip((t - left) / np.maximum(right - left, 1), 0, 1)
    series = series[left] + part[:, None] * (series[right] - series[left])
    return fftconvolve(series, kernel[:, None], axes=0)[:len(t)]


def whitening(power: np.ndarray, period: float) -> np.ndarray:
    """
    Causal filters (C, L) that make noise white, of its power (bands, C) in the used bands.

    The filter is the minimum phase one, by the cepstrum. In a closed loop commands depend on past
    noise, and only innovations are independent of it.
    """
    n = 4096
    frequency = np.fft.rfftfreq(n, period)
    top = 0.5 / period
    edges = [e for e in EDGES[:len(power)] if e < top]
    edges = edges + [min(EDGES[len(edges)], top)] if len(edges) < len(power) else edges
    middle = np.sqrt(np.maximum(edges[1:-1], 1e-9) * np.array(edges[2:]))
    middle = np.concatenate([[edges[1] / 2], middle])
    taps = int(TAPS / period)
    out = np.zeros((power.shape[1], taps))
    for c in range(power.shape[1]):
        density = np.exp(np.interp(np.log(np.maximum(frequency, 1e-3)), np.log(middle),
                                   np.log(power[1:len(middle) + 1, c])))
        cepstrum = np.fft.irfft(-0.5 * np.log(density))
        cepstrum[1:n // 2] *= 2
        cepstrum[n // 2 + 1:] = 0
        out[c] = np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:taps]
    return out


def pooled(spectra: list[Spectrum]) -> np.ndarray:
    """(bands, C, C) mean noise of flights with the same channels."""
    return np.mean([s.noise for s in spectra], axis=0)
