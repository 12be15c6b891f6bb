"""
Numbers of a comparison, summarised over all flights of one task, conditions and controller.

The summary is part of the JSON file, and the page takes each of its numbers from it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from zlib import crc32

import numpy as np

from beetle_omni_ros.comparison.flights import Flight
from beetle_omni_ros.control import registry
from beetle_omni_ros.runs import table as published
from beetle_omni_ros.runs.metrics import POSE_KEYS

PREFIX = 'published_'    # prefix of a controller in the publication
# Colours of controllers outside the package, chosen by name.
SPARE = ('#2a9d4b', '#7b4fb0', '#008c95', '#a0522d', '#6b7f1e')
CONDITIONS = {
    'nominal': 'simulator as measured: multibody plant, second-order servos, rotor lag, sensor '
               'noise, every delay, state estimation by the EKF',
    'published': "the same with the publication's randomisation, drawn from the seed: mass, "
                 'inertia, centre of mass, sensor biases, more noise, latencies',
}
# Column of the publication's numbers -> its name there.
PUBLISHED = {f'{PREFIX}{name}': entry.label for name, entry in reversed(
    registry.SHIPPED.items()) if entry.label in published.RANDOM_POSES}
# Key of the summary -> keys of mean and standard deviation in the metrics of a flight.
EFFORT = {'hover_speed_m_s': ('hover_speed_mean_m_s', 'hover_speed_std_m_s'),
          'hover_angular_speed_rad_s': ('hover_angular_speed_mean_rad_s',
                                        'hover_angular_speed_std_rad_s'),
          'joint_error_rad': ('joint_error_mean_rad', 'joint_error_std_rad'),
          'thrust_N': ('thrust_mean_N', 'thrust_std_N')}


@dataclass(frozen=True)
class Look:
    """Label and text of a controller, and its line: colour, dashes, marker."""

    label: str
    text: str
    colour: str
    dashes: str | tuple = '-'
    marker: str = 'o'


def look(controller: str) -> Look:
    """Look of a controller, or of its published counterpart."""
    name = controller.removeprefix(PREFIX)
    entry = registry.SHIPPED.get(name)
    if entry is None:
        return Look(name, '', SPARE[crc32(name.encode()) % len(SPARE)], (0, (4, 1, 1, 1)), 'X')
    colour, dashes, marker = entry.line
    if name != controller:
        return Look(entry.label, 'the publication', colour, ':', '*')
    return Look(entry.label, entry.description, colour, dashes, marker)


def task_title(task: str) -> str:
    """Heading of a task."""
    titles = {'waypoints': 'Five waypoints', 'lemniscate': '3D lemniscate',
              'force': 'Force disturbance', 'torque': 'Torque disturbance',
              'payload': 'Payload', 'hover': 'Steady hover'}
    if task.startswith('random') and task[6:].isdigit():
        return f'{task[6:]} random poses'
    return titles.get(task, f'Poses of {Path(task).name}')


def summarise(flown: dict[Flight, dict]) -> dict:
    """
    Summarise results of :func:`fly_flight`.

    Returns:
        ``tasks``: task -> conditions -> controller -> numbers, with published numbers under the
        conditions 'paper'; ``compute``: CPU times.

    """
    summary: dict = {}
    groups: dict[tuple, list] = {}
    for flight in sorted(flown, key=lambda flight: flight.seed):
        key = (flight.task, flight.conditions, flight.controller)
        groups.setdefault(key, []).append((flight, flown[flight]))
    for (task, conditions, controller), results in groups.items():
        numbers = summary.setdefault(task, {}).setdefault(conditions, {})
        numbers[controller] = _group(task, results)
    for task, by_conditions in summary.items():
        if paper := _paper(task):
            by_conditions['paper'] = paper
    return {'tasks': summary, 'compute': _compute(flown)}


def _group(task, results):
    """Numbers of one controller in one task under one set of conditions."""
    made = {'seeds': [flight.seed for flight, _ in results],
            'failures': {str(flight.seed): result['failure'] for flight, result in results
                         if result['failure']}}
    judged = [result['metrics'] for _, result in results if result['metrics']]
    made['crashed'] = sum(bool(metrics['crashed']) for metrics in judged)
    made['flights'] = len(results)
    if not judged:
        return made
    made.update(_poses(judged))
    for key, (mean, std) in EFFORT.items():
        made[key] = _pooled(judged, mean, std)
    made['joint_error_hover_rad'] = {'mean': _mean(m['joint_error_hover_mean_rad']
                                                   for m in judged)}
    made['command_change_rms'] = {
        name: _root_mean_square(m['hover_command_change_rms'][name] for m in judged)
        for name in ('joint_rad', 'thrust_N')}
    if task == 'waypoints':
        made['by_pose'] = _by_pose([pose for m in judged for pose in m['poses']])
    for kind, make in (('trajectory', _tracking), ('payload', _payload), ('hover', _hover)):
        if parts := [m[kind] for m in judged if kind in m]:
            made[kind] = make(parts)
    if 'payload' in made:
        made['payload_height_max_m'] = _most(
            abs(end) for entry in made['payload']
            for end in _known(entry['height_error_m'][which] for which in ('min', 'max')))
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        if parts := [m[kind] for m in judged if kind in m]:
            made[kind] = _levels(parts, unit)
    return made


def _poses(judged):
    poses = [pose for metrics in judged for pose in metrics['poses']]
    return {'poses': len(poses), 'reached': sum(pose['reached'] for pose in poses),
            'flown': sum(pose['U_position_m'] is not None for pose in poses),
            **{key: _spread(pose[key] for pose in poses) for key in POSE_KEYS}}


def _by_pose(poses):
    """One entry for each different target, in the order of the flights."""
    groups: dict[tuple, list] = {}
    for pose in poses:
        groups.setdefault(tuple(round(v, 4) for v in pose['target']), []).append(pose)
    return [{'target': list(target), 'flown': len(group),
             **{key: _spread(pose[key] for pose in group) for key in POSE_KEYS}}
            for target, group in groups.items()]


def _tracking(parts):
    """Errors over all rounds of all flights, and the range of the rounds' means."""
    rounds = [part for tracking in parts for part in tracking['rounds']]
    made: dict = {'rounds': len(rounds)}
    for name, unit in (('position', 'm'), ('orientation', 'deg')):
        means = [part[f'{name}_mean_{unit}'] for part in rounds]
        made[f'{name}_{unit}'] = {
            **_pooled(rounds, f'{name}_mean_{unit}', f'{name}_std_{unit}'),
            'min': _least(part[f'{name}_min_{unit}'] for part in rounds),
            'max': _most(part[f'{name}_max_{unit}'] for part in rounds),
            'round_min': _least(means), 'round_max': _most(means)}
    return made


def _payload(parts):
    masses = sorted({entry['payload_kg'] for part in parts for entry in part})
    return [{'payload_kg': mass, **{
        key: _spread(entry[key] for part in parts for entry in part
                     if entry['payload_kg'] == mass)
        for key in ('height_error_m', 'position_m', 'orientation_deg')}} for mass in masses]


def _hover(parts):
    return {f'{name}_{unit}': {**_pooled(parts, f'{name}_mean_{unit}', f'{name}_std_{unit}'),
                               'max': _most(part[f'{name}_max_{unit}'] for part in parts)}
            for name, unit in (('position', 'm'), ('orientation', 'deg'))}


def _levels(parts, unit):
    """Errors at each level, and the level of lost control in each flight."""
    lost = [part[f'lost_at_{unit}'] for part in parts]
    known = [level for level in lost if level is not None]
    steps = sorted({entry[f'level_{unit}'] for part in parts for entry in part['levels']})
    levels = []
    for step in steps:
        entries = [entry for part in parts for entry in part['levels']
                   if entry[f'level_{unit}'] == step]
        levels.append({'level': step, 'flown': len(entries),
                       'lost': sum(entry['lost'] for entry in entries),
                       **{key: _spread(entry[key] for entry in entries)
                          for key in ('peak_position_m', 'peak_orientation_deg',
                                      'end_position_m', 'end_orientation_deg')}})
    return {'lost_at': lost, 'lost_min': min(known, default=None),
            'lost_max': max(known) if known and len(known) == len(lost) else None,
            'withstood_min': _least(part[f'withstood_{unit}'] for part in parts),
            'levels': levels}


def _compute(flown):
    """CPU time of a step of each controller over all its flights."""
    made = {}
    for controller in dict.fromkeys(flight.controller for flight in flown):
        times = [{**result['metrics']['compute_ms'], 'steps': result['metrics'].get('steps', 0)}
                 for flight, result in flown.items()
                 if flight.controller == controller and result['metrics']
                 and result['metrics']['compute_ms'].get('median') is not None]
        if times:
            made[controller] = {
                'median': float(np.median([t['median'] for t in times])),
                'p99': _most(t['p99'] for t in times), 'max': _most(t['max'] for t in times),
                'deadline_misses': sum(t['deadline_misses'] for t in times),
                'steps': sum(t['steps'] for t in times), 'flights': len(times)}
    return made


def _paper(task):
    """Published numbers of a task: published controller -> numbers in the form of the summary."""
    made: dict = {}
    for column, name in PUBLISHED.items():
        real = f'{name}, real robot'
        if task.startswith('random'):
            made[column] = {**_published_poses(published.RANDOM_POSES[name]),
                            **{key: {'mean': published.RANDOM_POSES[name][mean],
                                     'std': published.RANDOM_POSES[name][std]}
                               for key, (mean, std) in EFFORT.items()}}
        elif task == 'waypoints':
            made[column] = {**_published_poses(published.WAYPOINTS[real]), 'by_pose': [
                {key: {'mean': value} for key, value in pose.items()}
                for pose in published.WAYPOINTS[real]['by_pose']]}
        elif task == 'lemniscate':
            tracking = published.LEMNISCATE[real]
            made[column] = {'trajectory': {f'{what}_{unit}': {
                part: tracking[f'{what}_{part}_{unit}'] for part in ('mean', 'std')}
                for what, unit in (('position', 'm'), ('orientation', 'deg'))}}
        elif task in ('force', 'torque'):
            unit = 'N' if task == 'force' else 'N_m'
            level = published.DISTURBANCE[name][f'{task}_{unit}']
            made[column] = {task: {'lost_min': level, 'lost_max': level}}
    return made


def _published_poses(numbers):
    return {key: {what: numbers[what][key] for what in ('mean', 'min', 'max')
                  if key in numbers.get(what, {})}
            for key in POSE_KEYS if key in numbers['mean']}


def _known(values: Iterable):
    return [float(value) for value in values if value is not None and isfinite(value)]


def _mean(values):
    values = _known(values)
    return float(np.mean(values)) if values else None


def _least(values):
    return min(_known(values), default=None)


def _most(values):
    return max(_known(values), default=None)


def _root_mean_square(values):
    values = _known(values)
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _spread(values):
    values = _known(values)
    if not values:
        return dict.fromkeys(('mean', 'median', 'min', 'max'))
    return {'mean': float(np.mean(values)), 'median': float(np.median(values)),
            'min': min(values), 'max': max(values)}


def _pooled(parts, mean, std):
    """Mean and standard deviation of all samples, from parts of equal size."""
    pairs = [(part[mean], part[std]) for part in parts
             if part.get(mean) is not None and part.get(std) is not None]
    if not pairs:
        return {'mean': None, 'std': None}
    means, deviations = np.array(pairs).T
    square = np.mean(deviations ** 2 + means ** 2) - np.mean(means) ** 2
    return {'mean': float(np.mean(means)), 'std': float(np.sqrt(max(square, 0.0)))}
