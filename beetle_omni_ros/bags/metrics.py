"""
Metrics of one flight, as in ``evaluate --json`` and ``fly --json``.

A pose lasts 8 s. U, the mean error over 7.0 to 7.5 s, measures the accuracy of hovering; L, the
mean error over 1.0 to 7.0 s, measures how fast the pose is reached (docs/reference/metrics.md).
"""

from collections import Counter
from itertools import groupby

import numpy as np

from beetle_omni_ros.bags.log import (
    errors,
    estimate_errors,
    FlightLog,
    hold,
    inside,
    motion,
    roll_pitch_yaw,
)
from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.tasks import (
    control_lost,
    GROUND_HEIGHT,
    HOVER,
    make_task,
    POSE_DURATION,
    STEPS,
    Task,
)
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import DISARMED, FALLBACK, LANDING, MOTORS_OFF, STOPPED
from beetle_omni_ros.model.schema import shortened

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
CRASHED = 'the robot crashed'
# [m/s] at the touchdown, [deg] after it: the simulated robot breaks (params/simulator.yaml)
FALL_SPEED, FALL_INCLINATION = 1.0, 60.0
TOUCHDOWN = 0.05  # [m] above the place where the robot lies at the end
SUMMARY = (('mean', np.mean), ('std', np.std), ('min', np.min), ('max', np.max))
POSE_KEYS = ('U_position_m', 'U_orientation_deg', 'L_position_m', 'L_orientation_deg')


def at(found, path: str):
    """Return the value at a path of keys and indices such as 'mean.U_position_m', or None."""
    for key in path.split('.'):
        try:
            found = found[int(key) if isinstance(found, list) else key]
        except (KeyError, IndexError, TypeError):
            return None
    return found


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
    return next(iter(metrics_by_controller(log, task).values()))


def metrics_by_controller(log: FlightLog, task: Task | None = None) -> dict[str, dict]:
    """Compute the metrics of each controller of a flight; 'unknown' if none flew."""
    task = task or task_of(log)
    parts = _split(log, task) or {'unknown': ([], [])}
    return {name: _controller_metrics(log, task, name, *part, is_alone=len(parts) == 1)
            for name, part in parts.items()}


def task_of(log: FlightLog) -> Task | None:
    """Make the named task in a log's metadata; None for pose files and flights without a task."""
    name = str(log.meta.get('task', ''))
    if not name or name.lower().endswith('.csv'):
        return None
    try:
        return make_task(name, int(log.meta.get('seed') or 0))
    except (OSError, TypeError, ValueError):    # whatever the metadata contains
        return None


def _split(log, task):
    """
    Split a flight by controllers.

    Returns:
        Controller -> indices of its pose targets that lasted to the end of U, and intervals
        (begin, end) of the flight towards its targets [s].

    """
    changes = log.active_controller()
    parts: dict[str, tuple[list, list]] = {name: ([], []) for _, name in changes if name}
    if not parts or not log.targets:
        return {}
    last = log.targets[-1]
    ends = [target.stamp for target in log.targets[1:]]
    ends.append(log.targets[0].stamp + task.duration if task else
                last.stamp + POSE_DURATION if isinstance(last, PoseTarget) else last.times[-1])
    if log.meta.get('interrupted'):
        ends[-1] = min(ends[-1], log.end)
    name = next(iter(parts))
    for k, (target, end) in enumerate(zip(log.targets, ends, strict=True)):
        shares: Counter = Counter()
        for (t, active), until in zip(changes, [*(t for t, _ in changes[1:]), np.inf],
                                      strict=True):
            if active:
                shares[active] += max(0.0, min(until, end) - max(t, target.stamp))
        flew = shares.total() > 0
        if flew:
            name = max(shares, key=lambda active: shares[active])
        poses, intervals = parts[name]
        if isinstance(target, PoseTarget) and end >= target.stamp + U_WINDOW[1] - 1e-3:
            poses.append(k)
        if flew:
            landed = next((float(t) for t, state in zip(log.state_t, log.states, strict=True)
                           if t > target.stamp
                           and state.state in (LANDING, DISARMED)), np.inf)
            intervals.append((target.stamp, min(end, landed)))
    return {name: part for name, part in parts.items() if any(part)}


def _controller_metrics(log, task, name, poses, intervals, *, is_alone):
    body = motion(log)
    ended_at, ending = _early_end(log, task)
    states = [state.state for state in log.states]
    hovered = [(t, until) for t, until, state in zip(
        log.state_t, [*log.state_t[1:], np.inf], states, strict=False) if state == FALLBACK]
    flown = [_pose(body, log.targets[k], task, ended_at, hovered) for k in poses]
    # If one controller flew the whole task, poses after an early end count as missed.
    whole = task and is_alone and not log.meta.get('interrupted')
    for missing in task.poses[len(flown):] if whole else ():
        flown.append({'target': [float(v) for v in missing], **dict.fromkeys(POSE_KEYS),
                      'reached': False})
    result: dict = {'poses': flown}
    for word, reduce in (('mean', np.mean), ('median', np.median), ('max', np.max),
                         ('min', np.min)):
        result[word] = {key: _reduced(reduce, [pose[key] for pose in flown]) for key in POSE_KEYS}
    result['success_rate'] = _reduced(np.mean, [pose['reached'] for pose in flown])
    result['crashed'] = _crashed(log, body, intervals)
    if landing := _landing(log, body, states):
        result['landing'] = landing
    if ending:
        result['ended'] = ending
    if log.meta.get('controller_error'):
        result['controller_error'] = log.meta['controller_error']
    reports = [entry.values['guidance'] for entry in log.diagnostics
               if entry.name.rpartition('/')[2] == f'{name}_node: controller'
               and 'guidance' in entry.values]
    own = log.meta.get('guidance') if log.meta.get('controller') == name else None
    result['guidance'] = reports[-1] if reports else own
    compute = log.compute.get(name, {})
    result['compute_ms'] = {key: compute.get(key)
                            for key in ('median', 'p99', 'max', 'deadline_misses')}
    windows = [(log.targets[k].stamp + U_WINDOW[0], log.targets[k].stamp + U_WINDOW[1])
               for k in poses if log.targets[k].stamp + U_WINDOW[1] <= ended_at]
    result.update(_effort(log, body, intervals, windows))
    t, distance, angle = estimate_errors(log)
    if np.any(used := inside(t, intervals)):
        result['estimation'] = {
            f'{name}_{what}_{unit}': _reduced(reduce, values[used])
            for what, reduce in (('rms', _rms), ('max', np.max))
            for name, unit, values in (('position', 'm', distance), ('orientation', 'deg', angle))}
    if task and log.targets and task.kind in KINDS:
        result[task.kind] = KINDS[task.kind](log, body, task, log.targets[0].stamp)
    return result


def _early_end(log, task):
    """
    Time and text of a landing or stop before the end of the task; (inf, '') for none.

    If the task is unknown or ends with the loss of control, only a landing with a fault counts.
    """
    start = log.targets[0].stamp if log.targets else np.inf
    due = start + task.duration - END_MARGIN if task else np.inf
    for t, state in zip(log.state_t, log.states, strict=True):
        kind, reason = state.state, shortened(state.fault)
        if t <= start or not (kind == LANDING or state.motors_off):
            continue
        if t < due and (reason or (task and task.kind not in ('force', 'torque'))):
            return float(t), f"{kind}{': ' if reason else ''}{reason} at {t - start:.1f} s"
        break
    stopped = log.meta.get('interrupted')
    return np.inf, f'interrupted at {log.end - log.begin:.1f} s' if stopped else ''


def _landing(log, body, states):
    """Speed at the touchdown of the last landing, and whether it was a fall; None without one."""
    k = 1 + max((k for k, state in enumerate(states)
                 if state not in (LANDING, *MOTORS_OFF)), default=-1)
    if not len(body.t) or LANDING not in states[k:k + 1] or states[-1] == LANDING:
        return None
    near = (body.t >= log.state_t[k]) & (body.position[:, 2] < body.position[-1, 2] + TOUCHDOWN)
    speed = _reduced(np.max, np.linalg.norm(body.velocity[near], axis=1))
    upright = rotations.matrix(body.quaternion[-1])[2, 2] > np.cos(np.radians(FALL_INCLINATION))
    return {'speed_m_s': speed, 'fell': bool(
        states[-1] == STOPPED or not upright or (speed or 0.0) > FALL_SPEED)}


def _pose(body, target, task, ended_at, hovered):
    result: dict = {'target': _numbers(target, task), **dict.fromkeys(POSE_KEYS)}
    for keys, window in ((POSE_KEYS[:2], U_WINDOW), (POSE_KEYS[2:], L_WINDOW)):
        begin, end = target.stamp + window[0], target.stamp + window[1]
        if end <= ended_at and body.covers(begin, end):
            both = errors(body, target, body.window(begin, end))
            result.update(zip(keys, (float(np.mean(values)) for values in both), strict=True))
    position, orientation = (result[key] for key in POSE_KEYS[:2])
    result['reached'] = bool(position is not None and position < REACHED_POSITION
                             and orientation < REACHED_ORIENTATION)
    begin, end = (target.stamp + edge for edge in U_WINDOW)
    if any(since < end and until > begin for since, until in hovered):
        result.update(reached=False, fallback=True)     # hover reached it, not the controller
    return result


def _numbers(target, task):
    """x, y, z [m], roll, pitch, yaw [deg]; as in the task if it contains this pose."""
    for pose in task.poses if task else ():
        if np.allclose(pose[:3], target.position, atol=1e-6) and rotations.geodesic_angle(
                rotations.from_rpy(*np.radians(pose[3:])), target.quaternion) < 1e-6:
            return [float(v) for v in pose]
    return [float(v) for v in (*target.position, *np.degrees(rotations.to_rpy(target.quaternion)))]


def _reduced(reduce, values):
    """One number of the known and finite values, or None."""
    values = np.array(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(reduce(values)) if values.size else None


def _rms(values):
    return np.sqrt(np.mean(values ** 2))


def failed(result: dict) -> str:
    """Why a flight failed by its results, or ''; tasks that end with lost control may crash."""
    if not {'force', 'torque'} & result.keys():
        if result.get('crashed'):
            return CRASHED
        if at(result, 'landing.fell'):
            return 'the robot fell in the landing'
    return result.get('controller_error', '')


def _crashed(log, body, intervals):
    """Whether the robot hit the ground, had an emergency stop, or has a non-finite position."""
    position = body.position[inside(body.t, intervals)]
    stopped = any(state.state == STOPPED for state, is_flown in zip(
        log.states, inside(log.state_t, intervals), strict=True) if is_flown)
    return bool(CRASH in log.states or stopped or not np.all(np.isfinite(position))
                or np.any(position[:, 2] < GROUND_HEIGHT))


def _effort(log, body, intervals, windows):
    """Joint error |q* - q|, thrust, motion and change of the command in the U windows."""
    stamps, first = np.unique(log.command.t, return_index=True)
    command = np.hstack([log.command.tilt[first], log.command.thrust[first]])
    thrust = command[:, 4:]
    joint = inside(log.joint.t, intervals)
    joint &= log.joint.t >= (stamps[0] if len(stamps) else np.inf)
    error = np.zeros((0, 4))
    if np.any(joint):
        error = np.abs(hold(stamps, command[:, :4], log.joint.t[joint])
                       - log.joint.position[joint])
    still = inside(body.t, windows)
    speed = np.linalg.norm(body.velocity[still], axis=1)
    rate = np.linalg.norm(body.angular_velocity[still], axis=1)
    used = thrust[inside(stamps, intervals)]
    changes = [np.zeros((0, 8))]
    for window in windows:
        mask = inside(stamps, [window])
        times, inner = stamps[mask], command[mask]
        if len(times) < 2:
            continue
        if not 0.8 <= np.median(np.diff(times)) / COMMAND_PERIOD <= 1.25:
            inner = hold(times, inner, np.arange(times[0], times[-1], COMMAND_PERIOD))
        changes.append(np.diff(inner, axis=0))
    change = np.concatenate(changes)
    return {'joint_error_mean_rad': _reduced(np.mean, error),
            'joint_error_std_rad': _reduced(np.std, error),
            'joint_error_hover_mean_rad': _reduced(
                np.mean, error[inside(log.joint.t[joint], windows)]),
            'thrust_mean_N': _reduced(np.mean, used), 'thrust_std_N': _reduced(np.std, used),
            'thrust_hover_mean_N': _reduced(np.mean, thrust[inside(stamps, windows)]),
            'thrust_max_N': _reduced(np.max, used),
            'hover_command_change_rms': {'joint_rad': _reduced(_rms, change[:, :4]),
                                         'thrust_N': _reduced(_rms, change[:, 4:])},
            'hover_speed_mean_m_s': _reduced(np.mean, speed),
            'hover_speed_std_m_s': _reduced(np.std, speed),
            'hover_angular_speed_mean_rad_s': _reduced(np.mean, rate),
            'hover_angular_speed_std_rad_s': _reduced(np.std, rate)}


def _summary(body, target, begin, end):
    """Mean, std, min, max of both errors in a window; None without samples."""
    both = errors(body, target, body.window(begin, end))
    return {f'{name}_{what}_{unit}': _reduced(reduce, values)
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
    return {'speed_mean_m_s': _reduced(
                np.mean, np.linalg.norm(body.velocity[whole], axis=1)),
            'angular_speed_mean_rad_s': _reduced(
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


# Kind of a task -> function of log, motion, task and its start [s].
KINDS = {'trajectory': _tracking, 'force': _levels, 'torque': _levels, 'wind': _winds,
         'pushes': _pushes, 'steps': _steps, 'payload': _payloads,
         'hover': lambda log, body, task, start: _summary(
             body, log.targets[0], start + POSE_DURATION, start + task.duration)}
