"""Whether gyroscope and attitude of tables turn together as their format declares them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import wilcoxon

from beetle_omni_ros.identify.recording.series import (
    aligned,
    FASTEST,
    filled,
    shifted,
    slow,
    turning,
)
from beetle_omni_ros.identify.recording.table import (
    columns_of,
    Format,
    FRAMES,
    ORDERS,
    SIGNALS,
    Table,
    table_of,
)
from beetle_omni_ros.model.schema import ParameterError

LEVEL = 1e-3        # probability at which another declaration fits better by chance
QUIET = 0.005       # [rad/s] errors of a small gyroscope, below which no difference counts
READINGS = 'quaternion', 'angular_velocity'


def read_tables(paths: Sequence[Path], form: Format) -> list[Table]:
    """
    Read flights of one format; refuse one that their gyroscopes contradict.

    Raises:
        LogError, ParameterError: unusable file; key of the format, its value and the expected one.

    """
    columns = [columns_of(path, form) for path in paths]
    tables = [table_of(path, own, form) for path, own in zip(paths, columns, strict=True)]
    if not tables or not set(READINGS) <= set(form.signals):
        return tables
    declared = np.concatenate([differences(table) for table in tables])
    found = []
    for (key, what, now, other), changed in _others(form).items():
        tried = np.concatenate([differences(table_of(path, own, changed))
                                for path, own in zip(paths, columns, strict=True)])
        gain = _disagreement(declared) - _disagreement(tried)
        if len(gain) and wilcoxon(
                gain, zero_method='zsplit', alternative='greater').pvalue < LEVEL:
            before, after = (1e3 * np.sqrt(np.median(x[:, 0])) for x in (declared, tried))
            found.append((float(np.median(gain)), (
                f"key '{key}.{what}': expected {other!r}, found {now!r}: the gyroscope differs by "
                f"{before:.1f} mrad/s from the turning of 'quaternion', with {other!r} by "
                f'{after:.1f} mrad/s')))
    if found:
        raise ParameterError(f'--format {form.name}: {max(found)[1]}')
    return tables


def _disagreement(powers):
    """(W,) ln of the difference of two series over their sum, of powers (W, 2)."""
    difference, both = np.log(powers + 3 * QUIET**2).T
    return difference - both


def _others(form):
    """(key, field, its value, another one) -> the format with it."""
    result: dict[tuple[str, str, str, str], Format] = {}
    for key, what, known in (('quaternion', 'frame', FRAMES['quaternion']),
                             ('quaternion', 'order', tuple(ORDERS)),
                             ('angular_velocity', 'frame', FRAMES['angular_velocity']),
                             ('angular_velocity', 'unit', tuple(SIGNALS['angular_velocity'][1]))):
        own = form.signals[key]
        now = getattr(own, what) or known[0]
        result |= {(key, what, now, other): replace(form, signals=form.signals | {
            key: replace(own, **{what: other})}) for other in known if other != now}
    return result


def differences(table: Table) -> np.ndarray:
    """
    Mean squares (W, 2) in windows [rad^2/s^2]: gyroscope minus the attitude's rates, and both.

    Those of both are added, so that for unrelated series the two are equal, in any unit. A shift
    of the clocks of each window and a mounting and a bias of the flight are taken out, as these
    are no matter of the format.
    """
    h = table.period
    (attitude, there), (felt, known) = (filled(x, h) for x in (
        aligned(table.values['quaternion']), table.values['angular_velocity']))
    if not (there & known).any():
        return np.zeros((0, 2))
    seen, felt = slow(turning(attitude, h), h, FASTEST), slow(felt, h, FASTEST)
    pairs = [(seen[rows + steps[cost.argmin()]], felt[rows])
             for rows, steps, cost in shifted(seen, felt, there & known, h)]
    if not pairs:
        return np.zeros((0, 2))
    x, y = (np.concatenate(part) for part in zip(*pairs, strict=True))
    axes = np.eye(3)
    slopes = np.stack([*(np.cross(x, axis) for axis in axes),
                       *(np.broadcast_to(axis, x.shape) for axis in axes)], axis=2)
    turn = np.linalg.lstsq(slopes.reshape(-1, 6), (y - x).ravel(), rcond=None)[0]
    made = [(a + np.cross(a, turn[:3]), b - turn[3:]) for a, b in pairs]
    return np.array([[3 * ((b - a)**2).mean(), 3 * (a**2 + b**2).mean()] for a, b in made])
