"""Metrics that only one kind of task has: rounds, disturbance levels, payloads, long hover."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.runs.body import errors, Motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.tasks import control_lost, POSE_DURATION, Task


def extras(log: FlightLog, body: Motion, task: Task, u_window: tuple[float, float]) -> dict:
    """
    What a task's kind adds to the metrics; empty for pose tasks.

    Args:
        log: the flight.
        body: whose motion is judged.
        task: what was flown; it began with the log's first target.
        u_window: of a pose [s].

    """
    if not log.targets:
        return {}
    start = log.targets[0].stamp
    if task.kind == 'trajectory':
        return {'trajectory': _tracking(log, body, task, start)}
    if task.kind in ('force', 'torque'):
        return {task.kind: _levels(log, body, task, start)}
    if task.kind == 'payload':
        return {'payload': _payloads(log, body, task, u_window)}
    if task.kind == 'hover':
        return {'hover': _summary(body, log.targets[0], start + POSE_DURATION,
                                  start + task.duration)}
    return {}


def _summary(body, target, begin, end):
    """Mean, std, min, max of both errors in a window; None without samples."""
    position, orientation = errors(body, target, body.window(begin, end))
    result = {}
    for name, unit, values in (('position', 'm', position), ('orientation', 'deg', orientation)):
        for what, reduce in (('mean', np.mean), ('std', np.std), ('min', np.min),
                             ('max', np.max)):
            result[f'{name}_{what}_{unit}'] = float(reduce(values)) if len(values) else None
    return result


def _tracking(log, body, task, start):
    """Tracking errors over all rounds and in each; a round that was cut short is None."""
    windows = [t for t in log.targets if isinstance(t, TrajectoryTarget)]
    if not windows:
        return {**dict.fromkeys(_summary_keys()), 'rounds': []}
    target = _joined(windows)
    rounds = [_summary(body, target, start + begin, start + end)
              if body.covers(start + begin, start + end) else dict.fromkeys(_summary_keys())
              for begin, end in task.rounds]
    whole = _summary(body, target, start + task.rounds[0][0], start + task.rounds[-1][1])
    return {**whole, 'rounds': rounds}


def _joined(windows):
    """One path of overlapping windows, as the reference node publishes; the newer one counts."""
    ends = [window.times[0] for window in windows[1:]] + [np.inf]
    kept = [window.times < end for window, end in zip(windows, ends, strict=True)]
    return TrajectoryTarget(*(
        np.concatenate([getattr(window, name)[mask]
                        for window, mask in zip(windows, kept, strict=True)])
        for name in ('times', 'positions', 'quaternions', 'velocities', 'angular_velocities')),
        stamp=windows[0].stamp)


def _summary_keys():
    return [f'{name}_{what}_{unit}' for name, unit in (('position', 'm'), ('orientation', 'deg'))
            for what in ('mean', 'std', 'min', 'max')]


def _levels(log, body, task, start):
    """Peak errors of each disturbance level and the level at which control was lost."""
    unit = 'N' if task.kind == 'force' else 'N_m'
    target = next(t for t in log.targets if isinstance(t, PoseTarget))
    levels, lost_at = [], None
    for level, begin, end in _level_windows(task, start):
        window = body.window(begin, end)
        if body.t[window].size == 0:
            break
        position, orientation = errors(body, target, window)
        ended_early = not body.covers(begin, end)
        lost = ended_early or _lost(body, target, window)
        levels.append({f'level_{unit}': level, 'peak_position_m': float(np.max(position)),
                       'peak_orientation_deg': float(np.max(orientation)),
                       'end_position_m': float(position[-1]),
                       'end_orientation_deg': float(orientation[-1]), 'lost': bool(lost)})
        if lost:
            lost_at = level
            break
    held = [entry[f'level_{unit}'] for entry in levels if not entry['lost']]
    return {'levels': levels, f'lost_at_{unit}': lost_at,
            f'withstood_{unit}': max(held, default=0.0)}


def _lost(body, target, window):
    last = window.stop - 1
    return any(control_lost(target, position) for position in body.position[window]) or \
        control_lost(target, body.position[last], body.quaternion[last])


def _level_windows(task, start):
    """(level, begin, end) of each run of segments with one level other than 0."""
    windows: list[list[float]] = []
    begin = start
    for segment in task.segments:
        end = begin + segment.duration
        if segment.level:
            if windows and windows[-1][0] == segment.level:
                windows[-1][2] = end
            else:
                windows.append([segment.level, begin, end])
        begin = end
    return [tuple(float(v) for v in window) for window in windows]


def _payloads(log, body, task, u_window):
    """Steady height error, positive above the target, and steady errors for each payload."""
    results = []
    targets = [t for t in log.targets if isinstance(t, PoseTarget)]
    for segment, target in zip(task.segments, targets, strict=False):
        begin, end = target.stamp + u_window[0], target.stamp + u_window[1]
        entry = {'payload_kg': segment.payload, 'height_error_m': None,
                 'position_m': None, 'orientation_deg': None}
        if body.covers(begin, end):
            window = body.window(begin, end)
            position, orientation = errors(body, target, window)
            height = body.position[window][:, 2] - target.position[2]
            entry.update(height_error_m=float(np.mean(height)),
                         position_m=float(np.mean(position)),
                         orientation_deg=float(np.mean(orientation)))
        results.append(entry)
    return results
