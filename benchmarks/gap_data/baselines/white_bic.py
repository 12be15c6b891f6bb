"""Baseline: forward selection by BIC as if the residual were white noise."""

from __future__ import annotations

from math import log

import numpy as np

from gap_data.baselines.answer import answer, deviations, fit
from gap_data.baselines.residual import EFFECTS, SIZE, SLICES

MOST = 12  # effects


def choose(columns, target):
    """Add the effect that lowers BIC most, until none does."""
    count, chosen = len(target), []
    size = np.linalg.norm(columns, axis=0) + 1e-12
    scaled = columns / size
    normal, side = scaled.T @ scaled, scaled.T @ target
    total = left = float(target @ target)

    def rest(names):
        k = np.concatenate([np.arange(SIZE)[SLICES[name]] for name in names])
        return max(total - float(side[k] @ np.linalg.lstsq(normal[np.ix_(k, k)], side[k],
                                                           rcond=1e-10)[0]), 1e-9 * total)

    while len(chosen) < MOST:
        trials = {name: rest([*chosen, name]) for name in EFFECTS if name not in chosen}
        gains = {name: count * log(left / after)
                 - (SLICES[name].stop - SLICES[name].start) * log(count)
                 for name, after in trials.items()}
        best = max(gains, key=gains.get)
        if gains[best] <= 0:
            break
        chosen.append(best)
        left = trials[best]
    if not chosen:
        return [], np.zeros(SIZE), np.zeros(SIZE)
    theta, left = fit(columns, target, chosen)
    return chosen, theta, deviations(columns, chosen, left / count)


def run_gap(runs, holdout, robot, apply, json_path, page, console) -> int:
    """Answer in the interface's JSON; writes no robot file and no page."""
    return answer(choose, runs, holdout, robot, json_path)
