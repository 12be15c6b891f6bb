"""
How loud each channel may be: sensors' own noise, measured where nothing moves as fast.

The noise of a fit is learnt from its residual, and so whatever no entry explains would become
noise. Here the residual is held against what the sensors' readings scatter by from one to the
next, through the same filters: a residual far beyond that is a gap, whatever its colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import CHANNELS, FlightModel, UNITS

THIRD = np.sqrt(20.0)   # standard deviation of a third difference of white noise


@dataclass(frozen=True)
class Loud:
    """
    A channel beyond its ceiling.

    Attributes:
        channel: its name.
        size: root mean square of the residual, in the channel's unit.
        ceiling: that it may have.
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
        return (f'{self.flight}: {self.channel} is off by {self.size:.3g} {unit} RMS, '
                f'{self.size / self.ceiling:.1f} times what its sensors and gusts may make')


def white_noise(series: np.ndarray) -> np.ndarray:
    """(n,) standard deviations of readings (N, n) that no motion explains."""
    return np.median(np.abs(np.diff(series, 3, axis=0)), axis=0) / 0.6745 / THIRD


def sensor_noise(model: FlightModel) -> dict[str, float]:
    """
    Group -> root mean square that the sensors' white noise leaves in a channel.

    White noise of standard deviation s, read every T, has s^2 T of power per Hz to both sides; the
    k-th derivative below an edge f keeps 2 s^2 T (2 pi)^(2k) f^(2k + 1) / (2k + 1) of it.
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
    """Group -> (channels,) largest root mean square of a sound residual."""
    seen = sensor_noise(model)
    force, torque = p.gust_ceiling
    limits = dict(zip('AWJ', p.model_ceiling, strict=True))
    made = {'B': np.array([force] * 3 + [torque] * 3)}
    for group, size in seen.items():
        made[group] = np.full(len(CHANNELS[group]), np.hypot(p.noise_ceiling * size,
                                                             limits[group]))
    return made


def too_loud(models: list[FlightModel], theta: dict[str, float],
             p: GapParameters) -> list[Loud]:
    """Channels whose residual is beyond its ceiling, the farthest first."""
    made = []
    for model in models:
        residual, limits = model.residual(theta), ceilings(model, p)
        for group, names in CHANNELS.items():
            size = np.sqrt((residual[group]**2).mean(axis=0))
            made += [Loud(name, float(s), float(limit), model.flight.name)
                     for name, s, limit in zip(names, size, limits[group], strict=True)
                     if s > limit]
    return sorted(made, key=lambda loud: -loud.size / loud.ceiling)
