"""Baseline: forward selection by BIC as if the residual were white noise."""

from __future__ import annotations

from math import log

from gap_data.baselines.answer import answer, deviations, fit
from gap_data.baselines.residual import EFFECTS, SIZE, SLICES

MOST = 12  # effects


def choose(columns, target):
    """Add the effect that lowers BIC most, until none does."""
    count, chosen = len(target), []
    left = float(target @ target)
    while len(chosen) < MOST:
        trials = {name: fit(columns, target, [*chosen, name])[1]
                  for name in EFFECTS if name not in chosen}
        gains = {name: count * log(left / rest)
                 - (SLICES[name].stop - SLICES[name].start) * log(count)
                 for name, rest in trials.items()}
        best = max(gains, key=gains.get)
        if gains[best] <= 0:
            break
        chosen.append(best)
        left = trials[best]
    if not chosen:
        return [], 0 * columns[0], 0 * columns[0]
    theta, left = fit(columns, target, chosen)
    assert len(theta) == SIZE
    return chosen, theta, deviations(columns, chosen, left / count)


def run_gap(runs, holdout, robot, apply, json_path, page, console) -> int:
    """Answer in the interface's JSON; writes no robot file and no page."""
    return answer(choose, runs, holdout, robot, json_path)
