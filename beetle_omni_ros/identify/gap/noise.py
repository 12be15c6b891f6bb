"""Autoregressive noise of the residual's channels, and ceilings of their RMS."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import CHANNELS, FlightModel, UNITS
from beetle_omni_ros.identify.inference.noise import autoregression, gain, whitened

THIRD = np.sqrt(20.0)   # standard deviation of a third difference of white noise


@dataclass(frozen=True)
class Noise:
    """
    An autoregression for each channel, the same in all flights.

    Attributes:
        taps: group -> (channels, order + 1) prediction-error filters, first entry 1.
        sigma: group -> (channels,) standard deviation of the innovation for fits, raised to the
            floors.
        seen: group -> (channels,) estimated standard deviation without floors; empty: ``sigma``.

    """

    taps: dict[str, np.ndarray]
    sigma: dict[str, np.ndarray]
    seen: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def white(cls, p: GapParameters) -> Noise:
        """White noise at three times the floors, as a start."""
        floors = _floors(p)
        return cls({g: np.ones((len(c), 1)) for g, c in CHANNELS.items()},
                   {g: 3 * floors[g] for g in CHANNELS})

    @classmethod
    def of(cls, residuals: list[dict[str, np.ndarray]], p: GapParameters) -> Noise:
        """
        Estimate the noise from the residuals of several flights, by group.

        No model is accurate enough for a channel below its floor.
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
        """The same noise with each channel at most at its RMS ceiling (group -> (channels,))."""
        shares = {group: np.minimum(1.0, ceilings[group] / np.maximum(size, 1e-12))
                  for group, size in self.spread.items()}
        return Noise(self.taps, {g: x * shares[g] for g, x in self.sigma.items()},
                     {g: x * shares[g] for g, x in self.seen.items()})

    def whiten(self, residual: dict[str, np.ndarray]) -> np.ndarray:
        """(n,) or (n, K) whitened residual or slopes of one flight, groups one after the other."""
        parts: list[np.ndarray] = []
        for group, taps in self.taps.items():
            parts += [whitened(residual[group][:, k], tap, sigma)
                      for k, (tap, sigma) in enumerate(zip(taps, self.sigma[group], strict=True))]
        return np.concatenate(parts)

    @property
    def spread(self) -> dict[str, np.ndarray]:
        """Group -> (channels,) standard deviation of the coloured noise."""
        return {group: self.sigma[group] * np.sqrt([gain(tap) for tap in taps])
                for group, taps in self.taps.items()}

    def places(self, counts: dict[str, int]) -> list[tuple[str, int, np.ndarray]]:
        """(group, channel, sample indices) in the order of :meth:`whiten`."""
        result = []
        for group, taps in self.taps.items():
            for k in range(len(taps)):
                result.append((group, k, np.arange(taps.shape[1] - 1, counts[group])))
        return result


def _floors(p):
    force, torque, world, rate, joint = p.floors
    return {'B': np.array([force] * 3 + [torque] * 3), 'A': np.full(3, world),
            'W': np.full(3, rate), 'J': np.full(4, joint)}


@dataclass(frozen=True)
class ExcessNoise:
    """
    A channel whose residual exceeds its ceiling.

    Attributes:
        channel: name of the channel.
        size: RMS of the residual, in the channel's unit.
        ceiling: its ceiling.
        flight: name of the recording.

    """

    channel: str
    size: float
    ceiling: float
    flight: str

    @property
    def text(self) -> str:
        """One sentence."""
        unit = UNITS[self.channel.rpartition('_')[0]]
        return (f'{self.flight}: the residual of {self.channel} is {self.size:.3g} {unit} RMS, '
                f'{self.size / self.ceiling:.1f} times the largest effect of sensors and gusts')


def white_noise(series: np.ndarray) -> np.ndarray:
    """(n,) standard deviations of white noise of readings (N, n), from third differences."""
    return np.median(np.abs(np.diff(series, 3, axis=0)), axis=0) / 0.6745 / THIRD


def sensor_noise(model: FlightModel) -> dict[str, float]:
    """
    Group -> RMS that the white noise of the sensors causes in a channel.

    White noise of standard deviation s and period T has the two-sided density s^2 T. The k-th
    derivative below an edge f keeps the variance 2 s^2 T (2 pi)^(2k) f^(2k + 1) / (2k + 1).
    """
    flight, p = model.flight, model.p

    def kept(size, t, edge, order):
        period = float(np.median(np.diff(t)))
        power = 2 * size**2 * period * (2 * np.pi)**(2 * order) * edge**(2 * order + 1)
        return power / (2 * order + 1)

    place, turn = white_noise(flight.pose[:, :3]).max(), 2 * white_noise(flight.pose[:, 3:]).max()
    force, rate = white_noise(flight.imu[:, :3]).max(), white_noise(flight.imu[:, 3:]).max()
    gravity = model.robot.gravity
    return {'A': np.sqrt(kept(place, flight.pose_t, p.world_edge, 2)
                         + kept(force, flight.imu_t, p.world_edge, 0)
                         + kept(gravity * turn, flight.pose_t, p.world_edge, 0)),
            'W': np.sqrt(kept(turn, flight.pose_t, p.rate_edge, 1)
                         + kept(rate, flight.imu_t, p.rate_edge, 0)),
            'J': np.sqrt(kept(model.signals.reading_noise, flight.joint_t, p.joint_edge, 0))}


def ceilings(model: FlightModel, p: GapParameters) -> dict[str, np.ndarray]:
    """Group -> (channels,) largest RMS of a valid residual."""
    seen = sensor_noise(model)
    force, torque = p.gust_ceiling
    limits = dict(zip('AWJ', p.model_ceiling, strict=True))
    result = {'B': np.array([force] * 3 + [torque] * 3)}
    for group, size in seen.items():
        result[group] = np.full(len(CHANNELS[group]), np.hypot(p.noise_ceiling * size,
                                                               limits[group]))
    return result


def channels_above_ceiling(models: list[FlightModel], theta: dict[str, float],
                           p: GapParameters) -> list[ExcessNoise]:
    """
    Channels whose residual exceeds its ceiling, largest ratio first.

    The noise model of a fit adapts to any unexplained residual. The ceiling comes from the scatter
    of the readings instead, so a large residual is a gap whatever its spectrum.
    """
    result = []
    for model in models:
        residual, limits = model.residual(theta), ceilings(model, p)
        for group, names in CHANNELS.items():
            size = np.sqrt((residual[group]**2).mean(axis=0))
            result += [ExcessNoise(name, float(s), float(limit), model.flight.name)
                       for name, s, limit in zip(names, size, limits[group], strict=True)
                       if s > limit]
    return sorted(result, key=lambda loud: -loud.size / loud.ceiling)
