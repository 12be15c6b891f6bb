"""
Numbers of a comparison: metrics of all flights of one task and conditions, by controller.

The summary is part of the JSON file, and the page takes each of its numbers from it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from math import isfinite, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtrit

from beetle_omni_ros.bags.metrics import at, CRASHED, failed, POSE_KEYS
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import PUSH_PERIOD, RISING, TILTS
from beetle_omni_ros.show.figures import line_of
from beetle_omni_ros.show.table import PUBLISHED as published
from beetle_omni_ros.show.table import TEXTS

# --- statistics ----------------------------------------------------------------------------------

# Intervals are expanded percentile intervals (T. C. Hesterberg, What teachers should know about
# the bootstrap, 2015): percentiles of resampled means, so far outside that ten flights have the
# width of Student's t. Plain percentiles are too narrow by a fifth there.
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


# --- metrics -------------------------------------------------------------------------------------

PREFIX = 'published_'    # prefix of a controller in the publication
# Column of the publication's numbers -> its name there.
PUBLISHED = {f'{PREFIX}{name}': entry.label for name, entry in reversed(
    registry.SHIPPED.items()) if entry.label in published['random']}
# Kind of a task -> published numbers, and whether they are of the real robot.
PRINTED: dict[str, tuple[dict, bool]] = {
    'random': (published['random'], False), **dict.fromkeys(
        RISING, (published['disturbance'], False)), **{
        kind: (published[kind], True) for kind in ('waypoints', 'lemniscate', 'wind', 'pushes')}}


@dataclass(frozen=True)
class Look:
    """Label and text of a controller, and its line: colour and dashes."""

    label: str
    text: str
    colour: str
    dashes: str | tuple = '-'


def look(controller: str) -> Look:
    """Look of a controller, or of its published counterpart."""
    name = controller.removeprefix(PREFIX)
    entry = registry.SHIPPED.get(name)
    line = line_of(name)
    if entry is None:
        return Look(name, '', *line)
    if name != controller:
        return Look(entry.label, 'the publication', line[0], ':')
    return Look(entry.label, entry.description, *line)


def kind_of(task: str) -> str:
    """Kind of a task: 'random', 'poses' for a pose file, or its name."""
    return task if task in TEXTS['titles'] else 'random' if task[6:].isdigit() else 'poses'


def task_title(task: str) -> str:
    """Heading of a task."""
    return TEXTS['titles'].get(task) or (f'{task[6:]} random poses' if kind_of(task) == 'random'
                                else f'Poses of {Path(task).name}')


@dataclass(frozen=True)
class Metric:
    """A number that a flight has once, or once for each pose."""

    title: str              # its name with the unit
    digits: int             # displayed digits
    of: str | Callable[[dict], Any]     # path in the metrics of a flight, or function of them
    printed: str = ''       # path of the published mean
    more: bool = False      # whether more is better
    glance: bool = False    # whether it is in the table of all experiments

    def value(self, judged: dict) -> Any:
        """Return the number of a flight, or the list of those of its poses."""
        return at(judged, self.of) if isinstance(self.of, str) else self.of(judged)


def _of_poses(key, scale=None):
    return lambda judged: [pose[key] if scale is None else scale * pose[key]
                           for pose in judged['poses']]


def _recovery(judged):
    return float(np.mean([PUSH_PERIOD if push['recovery_s'] is None else push['recovery_s']
                          for push in judged['pushes']['pushes']]))


def _worst_height(judged):
    heights = [entry['height_error_m'] for entry in judged['payload']]
    return None if None in heights else max(map(abs, heights))


def _errors(kind):
    """Mean and largest errors of a trajectory or a hover."""
    return {f'{name}{end}': Metric(
        f'{text}{name} error [{unit}]', digits, f'{kind}.{name}_{part}_{unit}',
        f'{name}_{part}_{unit}' if part == 'mean' else '', glance=part == 'mean')
        for name, unit, digits in (('position', 'm', 4), ('orientation', 'deg', 3))
        for end, part, text in (('', 'mean', ''), ('_max', 'max', 'largest '))}


def _disturbance(kind, _, levels, *times):
    unit, beyond = 'N' if kind == 'force' else 'N_m', 2.0 * levels[-1] - levels[-2]

    def lost(judged):
        level = judged[kind][f'lost_at_{unit}']
        return float(beyond if level is None else level)

    return {'lost': Metric(f"control lost at [{unit.replace('_', ' ')}]", 1, lost,
                           f'{kind}_{unit}', more=True, glance=True)}


_CHANGES = {     # of the commands in 10 ms at the target
    f'change_{key}': Metric(f'{name} command change in 10 ms, RMS [{unit}]', digits,
                            f'hover_command_change_rms.{key}')
    for key, name, unit, digits in (('joint_rad', 'tilt', 'rad', 5),
                                    ('thrust_N', 'thrust', 'N', 4))}
_POSES = {
    **{key: Metric(title, digits, _of_poses(key), f'mean.{key}', glance=True)
       for key, title, digits in zip(POSE_KEYS, (
           'U ‖p error‖ [m]', 'U ‖θ error‖ [deg]', 'L ‖p error‖ [m]', 'L ‖θ error‖ [deg]'),
           (4, 2, 3, 2), strict=True)},
    'reached': Metric('poses reached [%]', 1, _of_poses('reached', 100.0), more=True, glance=True),
    **{key: Metric(title, digits, path, path) for key, title, digits, path in (
        ('speed', '‖v‖ at the target [m/s]', 4, 'hover_speed_mean_m_s'),
        ('rate', '‖ω‖ at the target [rad/s]', 4, 'hover_angular_speed_mean_rad_s'),
        ('joint_error', '|q* − q| [rad]', 4, 'joint_error_mean_rad'))},
    'joint_error_hover': Metric('|q* − q| at the target [rad]', 4, 'joint_error_hover_mean_rad'),
    'thrust': Metric('thrust f* [N]', 2, *2 * ['thrust_mean_N']), **_CHANGES}
# Kind of a task -> key -> metric.
METRICS: dict[str, dict[str, Metric]] = {
    'random': _POSES, 'poses': _POSES,
    'waypoints': {
        **{key: replace(_POSES[key], of=f'mean.{key}', glance=key in POSE_KEYS[:2])
           for key in POSE_KEYS},
        'reached': Metric('poses reached [%]', 1, lambda judged: 100.0 * (
            judged['success_rate'] or 0.0), more=True)},
    **{name: _errors('trajectory') for name in TILTS},
    'wind': {path: Metric(f'strongest wind: {name} {text} [{unit}]', digits, f'wind.-1.{path}',
                          path, glance=True)
             for name, unit, digits in (('position', 'm', 4), ('orientation', 'deg', 2))
             for part, text in (('mean', 'error'), ('std', 'standard deviation'))
             for path in (f'{name}_{part}_{unit}',)},
    'pushes': {
        'recovery': Metric('recovery to 0.02 m and 2 deg [s]', 2, _recovery, glance=True),
        'speed': Metric('mean speed [m/s]', 3, 'pushes.speed_mean_m_s', 'speed_mean_m_s'),
        'rate': Metric('mean body rate [rad/s]', 3, 'pushes.angular_speed_mean_rad_s',
                       'angular_speed_mean_rad_s')},
    **{name: _disturbance(*of) for name, of in RISING.items()},
    'payload': {'worst': Metric('largest height error [m]', 4, _worst_height, glance=True)},
    'hover': {**_errors('hover'), **{key: replace(metric, glance=True)
                                     for key, metric in _CHANGES.items()}}}


def summarise(flown: dict[Any, dict]) -> dict:
    """
    Summarise results of :func:`fly_flight`.

    Returns:
        ``tasks``: task -> conditions -> ``flights`` (controller -> seeds, failures, lost) and
        ``metrics`` (name in :data:`METRICS` -> :func:`compared`); ``compute_ms``:
        controller -> CPU time of a step, median of the flights' medians.

    """
    summary: dict = {}
    groups: dict[tuple, dict] = {}
    for flight, result in flown.items():
        groups.setdefault((flight.task, flight.conditions), {}).setdefault(
            flight.controller, {})[flight.seed] = result
    for (task, conditions), by_name in groups.items():
        judged = {name: {seed: by_seed[seed]['metrics'] for seed in sorted(by_seed)
                         if by_seed[seed]['metrics']} for name, by_seed in by_name.items()}
        summary.setdefault(task, {})[conditions] = {
            'flights': {name: {
                'seeds': sorted(by_seed),
                'failures': {str(seed): result['failure'] for seed, result in by_seed.items()
                             if result['failure']},
                'lost': sum(failed(one) == CRASHED for one in judged[name].values())}
                for name, by_seed in by_name.items()},
            'metrics': {key: compared({name: _sample(metric, by_seed)
                                       for name, by_seed in judged.items()}, metric.more)
                        for key, metric in METRICS[kind_of(task)].items()}}
    times: dict[str, list] = {}
    for flight, result in flown.items():
        median = at(result, 'metrics.compute_ms.median')
        if median is not None:
            times.setdefault(flight.controller, []).append(median)
    return {'tasks': summary, 'compute_ms': {
        name: float(np.median(values)) for name, values in times.items()}}


def _sample(metric, by_seed):
    """Values of a controller by (seed,), or by (seed, pose)."""
    sample = {}
    for seed, judged in by_seed.items():
        value = metric.value(judged)
        sample |= {(seed, k): each for k, each in enumerate(value)} \
            if isinstance(value, list) else {(seed,): value}
    return sample


def printed(task: str, metric: Metric, column: str) -> dict:
    """Published mean of a metric, with std, min and max where they are printed; {} for none."""
    numbers, real = PRINTED.get(kind_of(task), ({}, False))
    published_numbers = numbers.get(PUBLISHED[column] + ', real robot' * real, {})
    parts = ('mean', 'std', 'min', 'max') if 'mean' in metric.printed else ('mean',)
    return {part: value for part in parts
            if (value := at(published_numbers, metric.printed.replace('mean', part))) is not None}
