"""
Metrics of single tasks: trajectories, rising disturbances, wind, pushes, steps, payloads.

Each function takes the log, the motion, the task and its start [s].
"""

from itertools import groupby

import numpy as np

from beetle_omni_ros.bags.log import errors, roll_pitch_yaw
from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.tasks import control_lost, HOVER, POSE_DURATION, STEPS

U_WINDOW = (7.0, 7.5)  # [s] after the target
L_WINDOW = (1.0, 7.0)  # [s]
WIND_ONSET = 2.0  # [s] at the start of each wind speed, not evaluated
RECOVERED = (0.02, 2.0)  # [m], [deg] errors after a push
SETTLED = 0.05  # of a step
AXES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
SUMMARY = (('mean', np.mean), ('std', np.std), ('min', np.min), ('max', np.max))


def reduced(reduce, values):
    """One number of the known and finite values, or None."""
    values = np.array(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(reduce(values)) if values.size else None


def _summary(body, target, begin, end):
    """Mean, std, min, max of both errors in a window; None without samples."""
    both = errors(body, target, body.window(begin, end))
    return {f'{name}_{what}_{unit}': reduced(reduce, values)
            for (name, unit), values in zip((('position', 'm'), ('orientation', 'deg')), both,
                                            strict=True)
            for what, reduce in SUMMARY}


def _summary_if_flown(body, target, begin, end):
    """Summary of a window that was flown to its end, else None."""
    return _summary(body, target, begin, end if body.covers(begin, end) else -np.inf)


def _tracking(log, body, task, start):
    """Tracking errors over all rounds and of each; None for an incomplete round."""
    windows = [t for t in log.targets if isinstance(t, TrajectoryTarget)]
    if not windows:
        return {**_summary(body, log.targets[0], np.inf, np.inf), 'rounds': []}
    # Of the overlapping windows of reference_node, newer ones precede.
    ends = [window.times[0] for window in windows[1:]] + [np.inf]
    kept = [window.times < end for window, end in zip(windows, ends, strict=True)]
    target = TrajectoryTarget(*(
        np.concatenate([getattr(window, name)[mask]
                        for window, mask in zip(windows, kept, strict=True)])
        for name in ('times', 'positions', 'quaternions', 'velocities', 'angular_velocities')))
    rounds = [_summary_if_flown(body, target, start + begin, start + end)
              for begin, end in task.rounds]
    whole = _summary(body, target, start + task.rounds[0][0], start + task.rounds[-1][1])
    return {**whole, 'rounds': rounds}


def _levels(log, body, task, start):
    """Peak errors, and recovery, of each level, and the level at which control was lost."""
    unit = 'N' if task.kind == 'force' else 'N_m'
    target = next(t for t in log.targets if isinstance(t, PoseTarget))
    levels, lost_at = [], None
    for level, begin, end in _level_windows(task, start):
        window = body.window(begin, end)
        if body.t[window].size == 0 or log.meta.get('interrupted') and log.end < end:
            break
        peaks = _peaks(body, target, window, begin)
        if task.kind == 'force':        # which acts for most of the level
            del peaks['recovery_s']
        position, orientation = errors(body, target, window)
        where, turned = body.position[window], body.quaternion[window]
        lost = not body.covers(begin, end) or control_lost(target, where[-1], turned[-1]) \
            or any(control_lost(target, position) for position in where)
        levels.append({f'level_{unit}': level, **peaks,
                       'end_position_m': float(position[-1]),
                       'end_orientation_deg': float(orientation[-1]), 'lost': bool(lost)})
        if lost:
            lost_at = level
            break
    held = [entry[f'level_{unit}'] for entry in levels if not entry['lost']]
    return {'levels': levels, f'lost_at_{unit}': lost_at,
            f'withstood_{unit}': max(held, default=0.0)}


def _peaks(body, target, window, begin):
    """Peak errors in a window, and the time from ``begin`` to the recovery."""
    position, orientation = errors(body, target, window)
    outside = (position > RECOVERED[0]) | (orientation > RECOVERED[1])
    return {'peak_position_m': float(np.max(position)),
            'peak_orientation_deg': float(np.max(orientation)),
            'recovery_s': settling_time(body.t[window] - begin, outside)}


def _winds(log, body, task, start):
    """Errors at each wind speed; None where it was not flown to the end."""
    return [{'speed_m_s': speed,
             **_summary_if_flown(body, log.targets[0], begin + WIND_ONSET, end)}
            for speed, begin, end in _level_windows(task, start)]


def _pushes(log, body, task, start):
    """Peak errors and recovery of each push, and mean speeds from the first push to the end."""
    windows, pushes = _level_windows(task, start), []
    for _, begin, end in windows:
        push = dict.fromkeys(('peak_position_m', 'peak_orientation_deg', 'recovery_s'))
        if body.covers(begin, end):
            push = _peaks(body, log.targets[0], body.window(begin, end), begin)
        pushes.append(push)
    whole = body.window(windows[0][1], windows[-1][2])
    return {'speed_mean_m_s': reduced(
                np.mean, np.linalg.norm(body.velocity[whole], axis=1)),
            'angular_speed_mean_rad_s': reduced(
                np.mean, np.linalg.norm(body.angular_velocity[whole], axis=1)),
            'pushes': pushes}


def _steps(log, body, task, start):
    """Response of each axis to its step away from the hover; None for one not flown to its end."""
    responses = []
    for k, (axis, step) in enumerate(zip(AXES, STEPS, strict=True)):
        unit = 'm' if k < 3 else 'deg'
        response = {**dict.fromkeys(('rise_s', 'settling_s', 'overshoot_percent')),
                    f'end_error_{unit}': None}
        target = log.targets[2 * k + 1] if len(log.targets) > 2 * k + 1 else None
        if target and body.covers(target.stamp, target.stamp + POSE_DURATION):
            window = body.window(target.stamp, target.stamp + POSE_DURATION)
            values = body.position[window, k] if k < 3 else \
                roll_pitch_yaw(body.quaternion[window])[:, k - 3]
            response = step_response(body.t[window] - target.stamp, values, step)
            end = response.pop('end') - HOVER[k] - step
            response[f'end_error_{unit}'] = abs(end)
        responses.append({'axis': axis, f'step_{unit}': float(step), **response})
    return responses


def step_response(times: np.ndarray, values: np.ndarray, step: float) -> dict:
    """
    Describe the response to a step, relative to its end, the mean of the last second.

    Args:
        times: (N,) since the step [s].
        values: (N,).
        step: commanded change of the value.

    Returns:
        ``rise_s`` from 10 to 90 %, ``settling_s`` to 5 %, ``overshoot_percent``, ``end``.

    """
    end = float(np.mean(values[times >= times[-1] - 1.0]))
    done = 1 + (values - end) / step
    low, high = (times[np.argmax(done >= share)] for share in (0.1, 0.9))
    return {'rise_s': float(high - low),
            'settling_s': settling_time(times, np.abs(done - 1) > SETTLED),
            'overshoot_percent': float(100 * max(0.0, np.max(done) - 1)), 'end': end}


def settling_time(times: np.ndarray, outside: np.ndarray) -> float | None:
    """Time after which ``outside`` (N,) stays False; None if it is True at the end."""
    late = np.flatnonzero(outside)
    if not len(late):
        return 0.0
    return None if late[-1] == len(times) - 1 else float(times[late[-1] + 1])


def _level_windows(task, start):
    """(level, begin, end) of consecutive segments with the same level other than 0."""
    windows = []
    for level, group in groupby(zip(task.segments, start + task.ends, strict=True),
                                key=lambda pair: pair[0].level):
        (first, end), *rest = group
        if level:
            windows.append((float(level), float(end - first.duration),
                            float(rest[-1][1] if rest else end)))
    return windows


def _payloads(log, body, task, start):
    """Steady height error, positive above the target, and steady errors for each payload."""
    results, targets = [], [t for t in log.targets if isinstance(t, PoseTarget)]
    for segment, target in zip(task.segments, targets, strict=False):
        begin, end = target.stamp + U_WINDOW[0], target.stamp + U_WINDOW[1]
        window = body.window(begin, end if body.covers(begin, end) else -np.inf)
        position, orientation = errors(body, target, window)
        results.append({
            'payload_kg': segment.payload, 'position_m': reduced(np.mean, position),
            'orientation_deg': reduced(np.mean, orientation), 'height_error_m': reduced(
                np.mean, body.position[window][:, 2] - target.position[2])})
    return results


# Kind of a task -> function of log, motion, task and its start [s].
KINDS = {'trajectory': _tracking, 'force': _levels, 'torque': _levels, 'wind': _winds,
         'pushes': _pushes, 'steps': _steps, 'payload': _payloads,
         'hover': lambda log, body, task, start: _summary(
             body, log.targets[0], start + POSE_DURATION, start + task.duration)}
