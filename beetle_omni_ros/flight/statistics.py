"""
Means of controllers with bootstrap intervals, and differences paired by pose and seed.

The intervals are expanded percentile intervals (T. C. Hesterberg, What teachers should know about
the bootstrap, 2015): percentiles of resampled means, so far outside that ten flights have the
width of Student's t. Plain percentiles are too narrow by a fifth there.
"""

from collections.abc import Mapping
from functools import cache
from math import isfinite, sqrt

import numpy as np
from scipy.special import ndtr, stdtrit

CONFIDENCE = 0.95
RESAMPLES = 10_000
SEED = 0
FEWEST = 6      # values of an interval; fewer have equal signs by chance in over 5 % of the cases

# Values of a controller by what was flown: (seed,) or (seed, pose).
Sample = Mapping[tuple[int, ...], float | None]


@cache
def _drawn(count):
    """(RESAMPLES, count) indices of the resampled values."""
    return np.random.default_rng(SEED).integers(count, size=(RESAMPLES, count), dtype=np.int32)


def described(values: np.ndarray) -> dict:
    """Mean, its interval [low, high] (None with less than FEWEST values), min, max, count."""
    count = len(values)
    if not count:
        return {'mean': None, 'low': None, 'high': None, 'min': None, 'max': None, 'count': 0}
    low = high = None
    if count >= FEWEST:
        far = stdtrit(count - 1, 0.5 - 0.5 * CONFIDENCE)
        tail = ndtr(far * sqrt(count / (count - 1)))
        low, high = map(float, np.quantile(values[_drawn(count)].mean(axis=1), (tail, 1 - tail)))
    return {'mean': float(values.mean()), 'low': low, 'high': high, 'min': float(values.min()),
            'max': float(values.max()), 'count': count}


def compared(samples: Mapping[str, Sample], more: bool = False) -> dict[str, dict]:
    """
    Describe each controller, and its difference to the one with the least mean.

    Args:
        samples: controller -> its values; None where it did not fly to the end.
        more: whether more is better.

    Returns:
        Controller -> :func:`described`, with ``difference``, the same of its paired differences
        to the best mean (None for that one), and ``best``: whether it has the best mean, and each
        interval of a difference to it excludes zero.

    """
    known = {name: {key: value for key, value in sample.items()
                    if value is not None and isfinite(value)} for name, sample in samples.items()}
    made = {name: described(np.array(list(values.values()))) for name, values in known.items()}
    sign, flown = -1.0 if more else 1.0, [name for name in made if made[name]['count']]
    if not flown:
        return {name: {**entry, 'difference': None, 'best': False} for name, entry in made.items()}
    first = min(flown, key=lambda name: sign * made[name]['mean'])
    for name, values in known.items():
        shared = [values[key] - known[first][key] for key in values if key in known[first]]
        made[name].update(best=False,
                          difference=None if name == first else described(np.array(shared)))
    worse = [made[name]['difference'] for name in flown if name != first]
    made[first]['best'] = bool(worse) and all(
        entry['low'] is not None and min(sign * entry['low'], sign * entry['high']) > 0
        for entry in worse)
    return made
