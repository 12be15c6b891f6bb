"""Whether the sensors of tables agree as their format declares them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
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
    G,
    ORDERS,
    SIGNALS,
    Table,
    table_of,
)
from beetle_omni_ros.model.schema import ParameterError

STRAIGHT_UP = np.array([0.0, 0.0, 1.0])
LEVEL = 1e-3        # probability at which another declaration fits better by chance
QUIET = 0.005       # [rad/s] errors of a small gyroscope, below which no difference counts
READINGS = 'quaternion', 'angular_velocity'
UNLIKE = -np.log(4)     # difference of two series over both; noise of small ones leaves a tenth
# A mean that differs by more, of gravity, is no bias or scale, and no change of speed in that
# time [s].
WEIGHED, LONG = 0.5, 4.0


def read_tables(paths: Sequence[Path], form: Format) -> list[Table]:
    """
    Read flights of one format; refuse one that their sensors contradict.

    Raises:
        LogError, ParameterError: unusable file; key of the format, its value and the expected one.

    """
    columns = [columns_of(path, form) for path in paths]
    tables = [table_of(path, own, form) for path, own in zip(paths, columns, strict=True)]
    for table in tables:
        _check_gravity(table)
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
            text = f"the gyroscope differs by {before:.1f} mrad/s from the turning of 'quaternion'"
            found.append((float(np.median(gain)), (
                f"key '{key}.{what}': expected {other!r}, found {now!r}: {text}, with {other!r} "
                f'by {after:.1f} mrad/s') if np.median(_disagreement(tried)) < UNLIKE else (
                f'{text}, and no other order, frame or unit agrees: check signs, axes and time')))
    if found:
        raise ParameterError(f'--format {form.name}: {max(found)[1]}')
    return tables


def _check_gravity(table):
    """
    Refuse an accelerometer whose mean in world is not gravity, in unit, sign or axes.

    Without attitude, or where an axis is not recorded, the median of its size is compared.
    """
    felt = table.values.get('specific_force')
    if felt is None or len(table) * table.period < LONG or not np.isfinite(felt).any():
        return
    known = np.isfinite(felt).all(axis=1)
    if known.any() and 'quaternion' in table.values:
        turn, there = filled(aligned(table.values['quaternion']), table.period)
        known &= there
        if not known.any():
            return
        mean = Rotation.from_quat(turn[known]).apply(felt[known]).mean(axis=0)
        wrong, text = mean - G * STRAIGHT_UP, 'its mean in world is ' + ', '.join(
            f'{x:.3g}' for x in mean) + f' m/s^2, expected about 0, 0, {G:.3g}'
    else:
        size = float(np.nanmedian(np.linalg.norm(np.nan_to_num(felt), axis=1)[
            np.isfinite(felt).any(axis=1)]))
        wrong, text = size - G, f'its size is {size:.3g} m/s^2, expected about {G:.3g}'
    if np.linalg.norm(wrong) > WEIGHED * G:
        raise ParameterError(f"--format {table.format.name}: key 'specific_force': {text}, in "
                             f'{table.name}: another unit, sign or axis')


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
