"""Floors of coloured noise limit the standard deviation of a channel whatever its spectrum."""

import numpy as np
import pytest

from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import CHANNELS

P = GapParameters.load()
FLOORS = dict(zip('BAWJ', (P.floors[0], *P.floors[2:]), strict=True))   # of the first channels
COUNT = 40000
KEEPS = [0.0, 0.97, -0.5]


def coloured(spread, keep, seed=0):
    """(COUNT,) x' = keep x + e in a plain loop; its variance is that of e over 1 - keep^2."""
    drive = spread * np.sqrt(1 - keep**2) * np.random.default_rng(seed).standard_normal(COUNT)
    x = np.empty(COUNT)
    now = spread * np.random.default_rng(seed + 1).standard_normal()
    for k, e in enumerate(drive):
        x[k] = now = keep * now + e
    return x


def learnt(ratio, keep):
    """Noise of residuals with a standard deviation of ``ratio`` floors, and the residuals."""
    rest = {g: np.stack([coloured(ratio * FLOORS[g], keep, 10 * k)
                         for k in range(len(names))], axis=1) for g, names in CHANNELS.items()}
    rest['B'][:, 3:] *= P.floors[1] / P.floors[0]
    return Noise.of([rest], P), rest


@pytest.mark.parametrize('keep', KEEPS)
def test_a_quiet_channel_gets_the_spread_of_its_floor_whatever_its_colour(keep):
    noise, rest = learnt(0.2, keep)
    for group, floor in FLOORS.items():
        assert noise.spread[group][:3] == pytest.approx(floor, rel=0.03)
    assert noise.spread['B'][3:] == pytest.approx(P.floors[1], rel=0.03)
    white = noise.whiten(rest).reshape(-1)
    seen = np.concatenate([(rest[g] / noise.spread[g]).ravel() for g in FLOORS])
    assert white.var() == pytest.approx(seen.var(), rel=0.02)
    assert white.var() == pytest.approx(0.2**2, rel=0.2)


@pytest.mark.parametrize('keep', KEEPS)
def test_a_loud_channel_keeps_its_estimate(keep):
    noise, rest = learnt(4.0, keep)
    white = noise.whiten(rest)
    assert noise.spread['J'] == pytest.approx(4 * FLOORS['J'], rel=0.1)
    assert white.var() == pytest.approx(1, rel=0.02)
    assert np.mean(white[1:] * white[:-1]) == pytest.approx(0, abs=0.02)
