"""Baseline: fit every parameter at once, report those whose interval leaves out zero."""

from __future__ import annotations

import numpy as np

from gap_data.baselines.answer import answer, deviations, fit
from gap_data.baselines.residual import EFFECTS, SLICES


def choose(columns, target):
    """All effects in one least squares, under white noise."""
    names = list(EFFECTS)
    theta, left = fit(columns, target, names)
    spread = deviations(columns, names, left / len(target))
    strength = {name: float(np.max(np.abs(theta[s]) / (spread[s] + 1e-15)))
                for name, s in SLICES.items()}
    kept = sorted((n for n in names if strength[n] > 1.96), key=lambda n: -strength[n])
    return kept, theta, spread


def run_gap(runs, holdout, robot, apply, json_path, page, console) -> int:
    """Answer in the interface's JSON; writes no robot file and no page."""
    return answer(choose, runs, holdout, robot, json_path)
