"""Residuals above the noise ceiling, and confirmation of named effects by held-out flights."""

from types import SimpleNamespace

from flights import model, Motion, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap import analysis
from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.noise import ceilings, channels_above_ceiling, Noise
from beetle_omni_ros.identify.gap.residual import CHANNELS
from beetle_omni_ros.identify.gap.rollouts import HORIZONS, Runs

MOTION = Motion(5, 20.0)


def readings(rate=0.0, drift=0.0):
    """A flight with white noise, ``rate`` [rad/s] of it in the gyroscope, and a slow error."""
    rng, flight = np.random.default_rng(0), MOTION.flight()
    flight.imu[:, 3:] += rate * rng.standard_normal((len(flight.imu), 3))
    flight.imu[:, 3] += drift * np.sin(2 * np.pi * 0.4 * flight.imu_t)
    return model(flight)


def test_white_noise_of_a_sensor_raises_its_own_ceiling():
    quiet, noisy = readings(), readings(rate=0.1)
    assert (ceilings(noisy, P)['W'] > ceilings(quiet, P)['W']).all()
    assert ceilings(noisy, P)['A'] == pytest.approx(ceilings(quiet, P)['A'])
    excess = channels_above_ceiling([noisy], {}, P)
    assert 'rate_x' not in [noise.channel for noise in excess]


def test_a_slow_error_is_not_taken_for_noise():
    excess = channels_above_ceiling([readings(drift=0.2)], {}, P)
    assert 'rate_x' in [noise.channel for noise in excess]


def runs(size, seed=0, count=160):
    """Errors of free runs of about ``size`` noise floors."""
    scatter = np.random.default_rng(seed).uniform(0.8, 1.2, (3, count, 5))
    return [Runs(size * scatter, np.full(count, 'hover', dtype=object), np.ones((3, 5)))]


def refuted(monkeypatch, before, after, gain=(0.0, 1.0)):
    a = Analysis(held_out=True, problem=SimpleNamespace(p=P),
                 runs={'before': runs(before), 'after': runs(after, 1)},
                 gaps={HORIZONS[analysis.JUDGED]: {'before': before, 'after': after}})
    held = SimpleNamespace(total=gain[0], error=gain[1])
    monkeypatch.setattr(analysis, '_gain_held_out', lambda a: held)
    return analysis._refuted(a, np.ones((3, 5)))


@pytest.mark.parametrize('before, after, gain, words', [
    (3.0, 1.0, (500.0, 20.0), ''), (np.nan, np.nan, (500.0, 20.0), 'diverge'),
    (3.0, np.inf, (500.0, 20.0), 'diverge'), (1.10, 1.16, (0.0, 1.0), 'worse'),
    (1.12, 1.15, (500.0, 20.0), 'worse'), (1.0, 1.0, (500.0, 20.0), ''),
    (1.0, 1.0, (5.0, 20.0), 'does not improve'),
    (20.0, 15.0, (500.0, 20.0), 'does not explain most')])
def test_a_name_needs_finite_free_runs_and_a_gain_on_held_out_flights(monkeypatch, before,
                                                                      after, gain, words):
    why = refuted(monkeypatch, before, after, gain)
    assert words in why and bool(words) == bool(why)


FLOORS = dict(zip('BAWJ', (P.floors[0], *P.floors[2:]), strict=True))   # of the first channels
COUNT = 40000
KEEPS = [0.97, -0.5]


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
