"""Coloured noise of the residual's channels, estimated from the residual itself."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import CHANNELS
from beetle_omni_ros.identify.inference.noise import autoregression, gain, whitened


@dataclass(frozen=True)
class Noise:
    """
    An autoregression for each channel, the same in all flights.

    Attributes:
        taps: group -> (channels, order + 1) prediction-error filters, first entry 1.
        sigma: group -> (channels,) standard deviation of what cannot be predicted, as a fit
            believes it: raised where a floor says so.
        seen: likewise, as the residual shows it; empty: as believed.

    """

    taps: dict[str, np.ndarray]
    sigma: dict[str, np.ndarray]
    seen: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def white(cls, p: GapParameters) -> Noise:
        """The floors, before anything is known."""
        floors = _floors(p)
        return cls({g: np.ones((len(c), 1)) for g, c in CHANNELS.items()},
                   {g: 3 * floors[g] for g in CHANNELS})

    @classmethod
    def of(cls, residuals: list[dict[str, np.ndarray]], p: GapParameters) -> Noise:
        """
        Estimate from the residuals of several flights, by group.

        A channel is never believed to be quieter than its floor: no model is that good.
        """
        taps, sigma, seen, floors = {}, {}, {}, _floors(p)
        for group, channels in CHANNELS.items():
            order = p.body_order if group == 'B' else p.other_order
            rows, levels, own = [], [], []
            for k in range(len(channels)):
                series = [r[group][:, k] for r in residuals]
                filtered, level = autoregression(series, order)
                coloured = level * np.sqrt(gain(filtered))
                rows.append(filtered)
                own.append(level)
                levels.append(level * max(1.0, floors[group][k] / max(coloured, 1e-12)))
            taps[group], sigma[group] = np.array(rows), np.array(levels)
            seen[group] = np.array(own)
        return cls(taps, sigma, seen)

    def bounded(self, ceilings: dict[str, np.ndarray]) -> Noise:
        """
        Return the same noise, no channel louder than it may be.

        Args:
            ceilings: group -> (channels,) root mean square of a sound residual.

        """
        shares = {group: np.minimum(1.0, ceilings[group] / np.maximum(size, 1e-12))
                  for group, size in self.spread.items()}
        return Noise(self.taps, {g: x * shares[g] for g, x in self.sigma.items()},
                     {g: x * shares[g] for g, x in self.seen.items()})

    def whiten(self, residual: dict[str, np.ndarray]) -> np.ndarray:
        """(n,) or (n, K) whitened samples of one flight's residual or slopes, groups in a row."""
        parts: list[np.ndarray] = []
        for group, taps in self.taps.items():
            parts += [whitened(residual[group][:, k], tap, sigma)
                      for k, (tap, sigma) in enumerate(zip(taps, self.sigma[group], strict=True))]
        return np.concatenate(parts)

    @property
    def spread(self) -> dict[str, np.ndarray]:
        """Group -> (channels,) standard deviation of the coloured noise, not whitened."""
        return {group: self.sigma[group] * np.sqrt([gain(tap) for tap in taps])
                for group, taps in self.taps.items()}

    def places(self, counts: dict[str, int]) -> list[tuple[str, int, np.ndarray]]:
        """(group, channel, sample indices) in the order of :meth:`whiten`."""
        made = []
        for group, taps in self.taps.items():
            for k in range(len(taps)):
                made.append((group, k, np.arange(taps.shape[1] - 1, counts[group])))
        return made


def _floors(p):
    force, torque, world, rate, joint = p.floors
    return {'B': np.array([force] * 3 + [torque] * 3), 'A': np.full(3, world),
            'W': np.full(3, rate), 'J': np.full(4, joint)}
