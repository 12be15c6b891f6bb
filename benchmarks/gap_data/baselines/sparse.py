"""Baseline: sequentially thresholded least squares (STLSQ) over all columns."""

from __future__ import annotations

import numpy as np

from gap_data.baselines.answer import answer, deviations
from gap_data.baselines.residual import EFFECTS, SIZE, SLICES

THRESHOLD = 0.1  # of the largest column's share of the residual
ROUNDS = 10


def choose(columns, target):
    """Drop columns of small contribution and solve again, until none is small."""
    size = np.linalg.norm(columns, axis=0) + 1e-12
    scaled = columns / size
    active, found = np.ones(SIZE, bool), np.zeros(SIZE)
    for _ in range(ROUNDS):
        found[:] = 0
        if not active.any():
            break
        found[active] = np.linalg.lstsq(scaled[:, active], -target, rcond=1e-9)[0]
        keep = np.abs(found) >= max(THRESHOLD * np.abs(found).max(),
                                    0.02 * np.linalg.norm(target))
        if np.array_equal(keep, active):
            break
        active = keep
    found[~active] = 0
    names = [name for name in EFFECTS if active[SLICES[name]].any()]
    names.sort(key=lambda name: -np.abs(found[SLICES[name]]).max())
    left = target + scaled @ found
    spread = (deviations(columns, names, float(left @ left) / len(target)) if names
              else np.zeros(SIZE))
    return names, found / size, spread


def run_gap(runs, holdout, robot, apply, json_path, page, console) -> int:
    """Answer in the interface's JSON; writes no robot file and no page."""
    return answer(choose, runs, holdout, robot, json_path)
