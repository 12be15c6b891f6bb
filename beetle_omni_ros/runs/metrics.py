"""
Metrics of one flight, as in ``evaluate --json`` and ``fly --json``.

A pose lasts 8 s. U, the mean error over 7.0 to 7.5 s, measures the accuracy of hovering; L, the
mean error over 1.0 to 7.0 s, measures how fast the pose is reached (docs/reference/metrics.md).
"""

from typing import NamedTuple

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import shortened
from beetle_omni_ros.runs.log import (
    errors,
    estimate_errors,
    FlightLog,
    hold,
    inside,
    Motion,
    motion,
    roll_pitch_yaw,
    target_ends,
)
from beetle_omni_ros.runs.tasks import (
    control_lost,
    GROUND_HEIGHT,
    HOVER,
    make_task,
    POSE_DURATION,
    STEPS,
    Task,
)

U_WINDOW = (7.0, 7.5)  # [s] after the target
L_WINDOW = (1.0, 7.0)  # [s]
REACHED_POSITION = 0.10  # [m]
REACHED_ORIENTATION = 10.0  # [deg]
WIND_ONSET = 2.0  # [s] at the start of each wind speed, not evaluated
RECOVERED = (0.02, 2.0)  # [m], [deg] errors after a push
SETTLED = 0.05  # of a step
AXES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
COMMAND_PERIOD = 0.010  # [s] for changes of the command
END_MARGIN = 0.1  # [s] before the end of the task, above which a landing is early
CRASH = 'emergency_stop:crash'    # supervisor/state after a crash
SUMMARY = (('mean', np.mean), ('std', np.std), ('min', np.min), ('max', np.max))
POSE_KEYS = ('U_position_m', 'U_orientation_deg', 'L_position_m', 'L_orientation_deg')


class ControllerPart(NamedTuple):
    """
    Part of a flight with one controller.

    ``poses`` are indices of pose targets in the log that lasted to the end of U, ``intervals``
    (begin, end) of the flight towards targets [s].
    """

    name: str
    poses: list[int]
    intervals: list[tuple[float, float]]


def metrics(log: FlightLog, task: Task | None = None) -> dict:
    """
    Compute the metrics of a flight with one controller.

    Args:
        log: the flight.
        task: flown task; None: the task in the log's metadata, if any.

    Returns:
        The dictionary of a controller in ``evaluate --json``, with None for unknown values. The
        keys contain the units.

    """
    results = metrics_by_controller(log, task)
    if not results:
        nothing = ControllerPart('unknown', [], [])
        return _controller_metrics(log, task or task_of(log), nothing, None)
    return next(iter(results.values()))


def metrics_by_controller(log: FlightLog, task: Task | None = None) -> dict[str, dict]:
    """Compute the metrics of each controller of a flight; see :func:`metrics`."""
    task = task or task_of(log)
    parts = _split(log, task)
    # If one controller flew the whole task, poses after an early end count as missed.
    expected = len(task.poses) if task and len(parts) == 1 else None
    return {part.name: _controller_metrics(log, task, part, expected) for part in parts}


def task_of(log: FlightLog) -> Task | None:
    """Make the named task in a log's metadata; None for pose files and flights without a task."""
    name = str(log.meta.get('task', ''))
    if not name or name.lower().endswith('.csv'):
        return None
    try:
        return make_task(name, int(log.meta.get('seed') or 0))
    except ValueError:
        return None


def _split(log, task):
    last = POSE_DURATION
    if task and log.targets:
        last = max(0.0, log.targets[0].stamp + task.duration - log.targets[-1].stamp)
    ends = target_ends(log, last)
    changes = log.active_controller()
    poses: dict[str, list[int]] = {}
    intervals: dict[str, list] = {}
    for name in log.controllers():
        poses[name], intervals[name] = [], []
    previous = next(iter(poses), None)
    for k, (target, end) in enumerate(zip(log.targets, ends, strict=True)):
        shares = _shares(changes, target.stamp, end)
        name = max(shares, key=shares.get) if shares else previous
        previous = name
        if name is None:
            continue
        lasted = end >= target.stamp + U_WINDOW[1] - 1e-3
        if isinstance(target, PoseTarget) and lasted:
            poses[name].append(k)
        if shares:
            intervals[name].append((target.stamp, min(end, log.end, _landing(log, target.stamp))))
    return [ControllerPart(name, poses[name], intervals[name]) for name in poses
            if poses[name] or intervals[name]]


def _shares(changes, begin, end):
    """Controller -> its flight time between ``begin`` and ``end`` [s]."""
    shares: dict[str, float] = {}
    for k, (t, name) in enumerate(changes):
        until = changes[k + 1][0] if k + 1 < len(changes) else np.inf
        time = min(until, end) - max(t, begin)
        if name and time > 0:
            shares[name] = shares.get(name, 0.0) + time
    return shares


def _landing(log, after):
    """Time of the first landing or disarming after ``after`` [s]; infinity for none."""
    return next((float(t) for t, state in zip(log.state_t, log.states, strict=True)
                 if t > after and state.partition(':')[0] in ('landing', 'disarmed')), np.inf)


def _controller_metrics(log, task, part, expected):
    body = motion(log)
    ended_at, ending = _early_end(log, task)
    poses = [_pose(body, log.targets[k], task, ended_at) for k in part.poses]
    for missing in (task.poses[len(poses):] if expected else ()):
        poses.append({'target': [float(v) for v in missing], **dict.fromkeys(POSE_KEYS),
                      'reached': False})
    result: dict = {'poses': poses}
    for name, reduce in (('mean', np.mean), ('median', np.median), ('max', np.max),
                         ('min', np.min)):
        result[name] = {key: _reduced(reduce, [pose[key] for pose in poses]) for key in POSE_KEYS}
    result['success_rate'] = float(np.mean([p['reached'] for p in poses])) if poses else None
    result['crashed'] = _crashed(log, body, part)
    if ending:
        result['ended'] = ending
    if log.meta.get('controller_error'):
        result['controller_error'] = log.meta['controller_error']
    result['guidance'] = _guidance(log, part.name)
    result['lowest'] = _lowest(log, body, part)
    compute = log.compute.get(part.name, {})
    result['compute_ms'] = {key: compute.get(key)
                            for key in ('median', 'p99', 'max', 'deadline_misses')}
    windows = [(log.targets[k].stamp + U_WINDOW[0], log.targets[k].stamp + U_WINDOW[1])
               for k in part.poses if log.targets[k].stamp + U_WINDOW[1] <= ended_at]
    result.update(_effort(log, part.intervals, windows))
    result.update(_stillness(body, windows))
    result.update(_timing(log, part.intervals))
    result.update(_estimation(log, part.intervals))
    if task:
        result.update(_task_metrics(log, body, task))
    return result


def _early_end(log, task):
    """
    Time and text of a landing or stop before the end of the task; (inf, '') for none.

    If the task is unknown or ends with the loss of control, only a landing with a fault counts.
    """
    start = log.targets[0].stamp if log.targets else np.inf
    due = start + task.duration - END_MARGIN if task else np.inf
    for t, state in zip(log.state_t, log.states, strict=True):
        kind, _, reason = shortened(state).partition(':')
        if t <= start or kind not in ('landing', 'emergency_stop', 'disarmed'):
            continue
        if t < due and (reason or (task and task.kind not in ('force', 'torque'))):
            return float(t), f"{kind}{': ' if reason else ''}{reason} at {t - start:.1f} s"
        break
    return np.inf, ''


def _guidance(log, controller):
    """Guidance of the controller, from its diagnostics or the metadata; None if unknown."""
    reports = [entry.values['guidance'] for entry in log.diagnostics
            if entry.name.rpartition('/')[2] == f'{controller}_node: controller'
            and 'guidance' in entry.values]
    if not reports and log.meta.get('controller') == controller:
        return log.meta.get('guidance')
    return reports[-1] if reports else None


def _pose(body: Motion, target, task, ended_at):
    means = []
    for window in (U_WINDOW, L_WINDOW):
        begin, end = target.stamp + window[0], target.stamp + window[1]
        if end <= ended_at and body.covers(begin, end):
            means += [float(np.mean(e)) for e in errors(body, target, body.window(begin, end))]
        else:
            means += [None, None]
    result = {'target': _numbers(target, task), **dict(zip(POSE_KEYS, means, strict=True))}
    result['reached'] = bool(means[0] is not None and means[0] < REACHED_POSITION
                             and means[1] < REACHED_ORIENTATION)
    return result


def _numbers(target, task):
    """x, y, z [m], roll, pitch, yaw [deg]; as in the task if it contains this pose."""
    for pose in task.poses if task else ():
        if np.allclose(pose[:3], target.position, atol=1e-6) and rotations.geodesic_angle(
                rotations.from_rpy(*np.radians(pose[3:])), target.quaternion) < 1e-6:
            return [float(v) for v in pose]
    return [float(v) for v in (*target.position, *np.degrees(rotations.to_rpy(target.quaternion)))]


def _reduced(reduce, values):
    values = [value for value in values if value is not None]
    return float(reduce(values)) if values else None


def failed(result: dict) -> bool:
    """Whether the results of a flight are a crash; tasks that end with lost control may crash."""
    return bool(result.get('crashed')) and not {'force', 'torque'} & result.keys()


def _crashed(log, body, part):
    """Whether the robot hit the ground, had an emergency stop, or has a non-finite position."""
    if any(state == CRASH for state in log.states):
        return True
    for begin, end in part.intervals:
        position = body.position[body.window(begin, end)]
        if not np.all(np.isfinite(position)) or np.any(position[:, 2] < GROUND_HEIGHT):
            return True
        if any(begin <= t <= end and state.startswith('emergency_stop')
               for t, state in zip(log.state_t, log.states, strict=True)):
            return True
    return False


def _lowest(log, body, part):
    """Lowest height of base_link and the pose during which it occurred; {} without samples."""
    rows = np.flatnonzero(inside(body.t, part.intervals))
    rows = rows[np.isfinite(body.position[rows, 2])]
    if not len(rows):
        return {}
    row = rows[np.argmin(body.position[rows, 2])]
    started = [n for n, k in enumerate(part.poses) if log.targets[k].stamp <= body.t[row]]
    return {'height_m': float(body.position[row, 2]), 'pose': started[-1] if started else None}


def _effort(log, intervals, windows):
    """Joint error |q* - q|, thrust, and change of the command while hovering."""
    stamps, first = np.unique(log.command_t, return_index=True)
    tilt, thrust = log.command_tilt[first], log.command_thrust[first]
    joint = inside(log.joint_t, intervals)
    joint &= log.joint_t >= (stamps[0] if len(stamps) else np.inf)
    error = np.zeros((0, 4))
    if np.any(joint):
        error = np.abs(hold(stamps, tilt, log.joint_t[joint]) - log.joint_position[joint])
    hovering = inside(log.joint_t[joint], windows)
    used, still = inside(stamps, intervals), inside(stamps, windows)
    return {'joint_error_mean_rad': _mean(error), 'joint_error_std_rad': _std(error),
            'joint_error_hover_mean_rad': _mean(error[hovering]),
            'thrust_mean_N': _mean(thrust[used]), 'thrust_std_N': _std(thrust[used]),
            'thrust_hover_mean_N': _mean(thrust[still]),
            'thrust_max_N': float(np.max(thrust[used])) if np.any(used) else None,
            'hover_command_change_rms': {
                'joint_rad': _change_rms(stamps, tilt, windows),
                'thrust_N': _change_rms(stamps, thrust, windows)}}


def _change_rms(stamps, values, windows):
    """RMS change of a command per 10 ms over the windows; None without commands."""
    changes = []
    for begin, end in windows:
        mask = inside(stamps, [(begin, end)])
        times, inner = stamps[mask], values[mask]
        if len(times) < 2:
            continue
        if not 0.8 <= np.median(np.diff(times)) / COMMAND_PERIOD <= 1.25:
            inner = hold(times, inner, np.arange(times[0], times[-1], COMMAND_PERIOD))
        changes.append(np.diff(inner, axis=0))
    stacked = np.concatenate(changes) if changes else np.zeros((0, 4))
    return float(np.sqrt(np.mean(stacked ** 2))) if len(stacked) else None


def _stillness(body, windows):
    mask = inside(body.t, windows)
    speed = np.linalg.norm(body.velocity[mask], axis=1)
    rate = np.linalg.norm(body.angular_velocity[mask], axis=1)
    return {'hover_speed_mean_m_s': _mean(speed), 'hover_speed_std_m_s': _std(speed),
            'hover_angular_speed_mean_rad_s': _mean(rate),
            'hover_angular_speed_std_rad_s': _std(rate)}


def _timing(log, intervals):
    """Delay from the stamp of the answered estimate to the recording; {} without delays."""
    mask = inside(log.command_t, intervals)
    delay = 1e3 * (log.command_received[mask] - log.command_t[mask])
    if not np.any(delay > 0):
        return {}
    return {'stamp_to_command_ms': {'median': float(np.median(delay)),
                                    'p99': float(np.percentile(delay, 99)),
                                    'max': float(np.max(delay))}}


def _estimation(log, intervals):
    """RMS and largest error of the estimate; {} without truth."""
    t, distance, angle = estimate_errors(log)
    used = inside(t, intervals)
    if not np.any(used):
        return {}
    distance, angle = distance[used], angle[used]
    return {'estimation': {'position_rms_m': float(np.sqrt(np.mean(distance ** 2))),
                           'orientation_rms_deg': float(np.sqrt(np.mean(angle ** 2))),
                           'position_max_m': float(np.max(distance)),
                           'orientation_max_deg': float(np.max(angle))}}


def _mean(values):
    values = values[np.isfinite(values)]
    return float(np.mean(values)) if values.size else None


def _std(values):
    values = values[np.isfinite(values)]
    return float(np.std(values)) if values.size else None


def _task_metrics(log: FlightLog, body: Motion, task: Task) -> dict:
    """Additional metrics of the task's kind, which began with the log's first target."""
    if not log.targets:
        return {}
    start = log.targets[0].stamp
    if task.kind == 'trajectory':
        return {'trajectory': _tracking(log, body, task, start)}
    if task.kind in ('force', 'torque'):
        return {task.kind: _levels(log, body, task, start)}
    if task.kind == 'payload':
        return {'payload': _payloads(log, body, task)}
    if task.kind == 'hover':
        return {'hover': _summary(body, log.targets[0], start + POSE_DURATION,
                                  start + task.duration)}
    if task.kind == 'wind':
        return {'wind': _winds(log, body, task, start)}
    if task.kind == 'pushes':
        return {'pushes': _pushes(log, body, task, start)}
    if task.kind == 'steps':
        return {'steps': _steps(log, body)}
    return {}


def _summary(body, target, begin, end):
    """Mean, std, min, max of both errors in a window; None without samples."""
    both = errors(body, target, body.window(begin, end))
    return {f'{name}_{what}_{unit}': float(reduce(values)) if len(values) else None
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
    target = _joined(windows)
    rounds = [_summary_if_flown(body, target, start + begin, start + end)
              for begin, end in task.rounds]
    whole = _summary(body, target, start + task.rounds[0][0], start + task.rounds[-1][1])
    return {**whole, 'rounds': rounds}


def _joined(windows):
    """One trajectory of the overlapping windows of reference_node; newer windows precede."""
    ends = [window.times[0] for window in windows[1:]] + [np.inf]
    kept = [window.times < end for window, end in zip(windows, ends, strict=True)]
    return TrajectoryTarget(*(
        np.concatenate([getattr(window, name)[mask]
                        for window, mask in zip(windows, kept, strict=True)])
        for name in ('times', 'positions', 'quaternions', 'velocities', 'angular_velocities')),
        stamp=windows[0].stamp)



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
            window = body.window(begin, end)
            position, orientation = errors(body, log.targets[0], window)
            outside = (position > RECOVERED[0]) | (orientation > RECOVERED[1])
            push = {'peak_position_m': float(np.max(position)),
                    'peak_orientation_deg': float(np.max(orientation)),
                    'recovery_s': settling_time(body.t[window] - begin, outside)}
        pushes.append(push)
    whole = body.window(windows[0][1], windows[-1][2])
    return {'speed_mean_m_s': _mean(np.linalg.norm(body.velocity[whole], axis=1)),
            'angular_speed_mean_rad_s': _mean(
                np.linalg.norm(body.angular_velocity[whole], axis=1)),
            'pushes': pushes}


def _steps(log, body):
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


def _payloads(log, body, task):
    """Steady height error, positive above the target, and steady errors for each payload."""
    results = []
    targets = [t for t in log.targets if isinstance(t, PoseTarget)]
    for segment, target in zip(task.segments, targets, strict=False):
        begin, end = target.stamp + U_WINDOW[0], target.stamp + U_WINDOW[1]
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
