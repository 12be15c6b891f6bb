"""Intervals, pairing and the rule of bold numbers, against closed forms."""

import numpy as np
import pytest
from scipy import stats

from beetle_omni_ros.flight.summary import compared, described


def sampled(values):
    return {(0, k): value for k, value in enumerate(values)}


@pytest.mark.parametrize('count', [10, 300])
def test_the_interval_of_normal_values_is_that_of_students_t(count):
    quantiles = stats.norm.ppf((np.arange(count) + 0.5) / count)    # an ideal normal sample
    values = 3.0 + 0.5 * quantiles
    found = described(values)
    low, high = stats.t.interval(0.95, count - 1, values.mean(), stats.sem(values))
    assert found['mean'] == pytest.approx(values.mean())
    width = 0.05 * (high - low)
    assert (found['low'], found['high']) == pytest.approx((low, high), abs=width)


def test_pairing_finds_a_small_difference_below_a_large_spread():
    generator = np.random.default_rng(0)
    poses = generator.uniform(0.0, 1.0, 300)    # the same poses are hard for both
    worse = poses + 0.01 + generator.normal(0, 0.02, 300)
    found = compared({'a': sampled(poses), 'b': sampled(worse)})
    assert found['a']['high'] > found['b']['low']       # the intervals of the means overlap
    assert found['a']['best'] and not found['b']['best']
    assert found['b']['difference']['mean'] == pytest.approx(np.mean(worse - poses))
    shuffled = dict(zip(sampled(worse), generator.permutation(worse), strict=True))
    assert not compared({'a': sampled(poses), 'b': shuffled})['a']['best']


def test_only_what_both_flew_to_the_end_is_paired():
    a, b = sampled([1.0, 2.0, 3.0, 4.0]), sampled([1.5, None, 3.4, np.nan])
    difference = compared({'a': a, 'b': b, 'none': sampled([None] * 4)})
    assert difference['b']['mean'] == pytest.approx(2.45)   # less than that of a, on fewer poses
    assert difference['a']['difference']['count'] == 2
    assert difference['a']['difference']['mean'] == pytest.approx(-0.45)
    assert difference['none']['count'] == 0 and difference['none']['mean'] is None
    assert not any(entry['best'] for entry in difference.values())


def test_a_best_number_differs_from_every_other():
    values = np.linspace(1.0, 2.0, 10)
    near = values + np.where(np.arange(10) % 2, 0.1, -0.09)
    far = values + 1.0
    assert compared({'a': sampled(values), 'far': sampled(far)})['a']['best']
    assert not compared({'a': sampled(values), 'near': sampled(near),
                         'far': sampled(far)})['a']['best']
    assert compared({'a': sampled(values), 'far': sampled(far)}, more=True)['far']['best']
    assert not compared({'a': sampled(values)})['a']['best']
    for count, best in ((1, False), (5, False), (6, True)):     # few flights: no interval
        few = compared({'a': sampled([1.0] * count), 'far': sampled([9.0] * count)})
        assert few['a']['best'] == best and (few['a']['low'] is not None) == best
    same = compared({'a': sampled(values), 'b': sampled(values)})
    assert not same['a']['best'] and not same['b']['best']
