"""Numbers with the interval in which they lie with 95 %."""

from __future__ import annotations

from math import sqrt

import numpy as np

Z = 1.959964


def share(hits: list[bool]) -> dict:
    """Proportion with Wilson's interval; None without any case."""
    count = len(hits)
    if not count:
        return {'value': None, 'interval': None, 'count': 0}
    p, z2 = sum(map(bool, hits)) / count, Z * Z / count
    middle = (p + z2 / 2) / (1 + z2)
    half = Z / (1 + z2) * sqrt(p * (1 - p) / count + z2 / (4 * count))
    return {'value': p, 'interval': [max(0.0, middle - half), min(1.0, middle + half)],
            'count': count}


def median(values: list[float], draws: int = 1000) -> dict:
    """Median with a bootstrap interval (percentiles)."""
    numbers = np.array([v for v in values if v is not None and np.isfinite(v)], float)
    if not len(numbers):
        return {'value': None, 'interval': None, 'count': 0}
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(numbers, (draws, len(numbers))), axis=1)
    return {'value': float(np.median(numbers)),
            'interval': [float(x) for x in np.percentile(medians, [2.5, 97.5])],
            'count': len(numbers)}
