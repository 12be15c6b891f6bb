"""
Metrics of one flight, as in ``evaluate --json`` and ``fly --json``.

A pose lasts 8 s. U, the mean error over 7.0 to 7.5 s, measures the accuracy of hovering; L, the
mean error over 1.0 to 7.0 s, measures how fast the pose is reached (docs/reference/metrics.md).
"""

from collections import Counter

import numpy as np

from beetle_omni_ros.bags.log import (
    errors,
    estimate_errors,
    FlightLog,
    hold,
    inside,
    motion,
)
from beetle_omni_ros.bags.task_metrics import KINDS, L_WINDOW, reduced, U_WINDOW
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.tasks import (
    GROUND_HEIGHT,
    make_task,
    POSE_DURATION,
    Task,
    TASK_FILES,
)
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import DISARMED, FALLBACK, LANDING, MOTORS_OFF, STOPPED
from beetle_omni_ros.model.schema import shortened

REACHED_POSITION = 0.10  # [m]
REACHED_ORIENTATION = 10.0  # [deg]
COMMAND_PERIOD = 0.010  # [s] for changes of the command
END_MARGIN = 0.1  # [s] before the end of the task, above which a landing is early
CRASH = 'emergency_stop:crash'    # supervisor/state after a crash
CRASHED = 'the robot crashed'
# [m/s] at the touchdown, [deg] after it: the simulated robot breaks (params/simulator.yaml)
FALL_SPEED, FALL_INCLINATION = 1.0, 60.0
TOUCHDOWN = 0.05  # [m] above the place where the robot lies at the end
POSE_KEYS = ('U_position_m', 'U_orientation_deg', 'L_position_m', 'L_orientation_deg')


def at(value, path: str):
    """Return the value at a path of keys and indices such as 'mean.U_position_m', or None."""
    for key in path.split('.'):
        try:
            value = value[int(key) if isinstance(value, list) else key]
        except (KeyError, IndexError, TypeError):
            return None
    return value


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
    """Make the named task in a log's metadata; None for files and flights without a task."""
    name = str(log.meta.get('task', ''))
    if not name or name.lower().endswith(TASK_FILES):
        return None
    try:
        return make_task(name, int(log.meta.get('seed') or 0))
    except (OSError, TypeError, ValueError):    # whatever the metadata contains
        return None


def _split(log, task):
    """Controller -> indices of its pose targets, and intervals (begin, end) towards them [s]."""
    # Only pose targets that lasted to the end of U.
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
    result: dict = {'controller': name, 'poses': flown}
    for word, reduce in (('mean', np.mean), ('median', np.median), ('max', np.max),
                         ('min', np.min)):
        result[word] = {key: reduced(reduce, [pose[key] for pose in flown]) for key in POSE_KEYS}
    result['success_rate'] = reduced(np.mean, [pose['reached'] for pose in flown])
    result['crashed'] = _crashed(log, body, intervals)
    if landing := _landing(log, body, states):
        result['landing'] = landing
    if ending:
        result['ended'] = ending
    result['alarms'] = {fault: t - log.begin for fault, t in log.named_faults().items()
                        if is_alone or inside(np.array([t]), intervals)[0]}
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
            f'{name}_{what}_{unit}': reduced(reduce, values[used])
            for what, reduce in (('rms', _rms), ('max', np.max))
            for name, unit, values in (('position', 'm', distance), ('orientation', 'deg', angle))}
    if task and log.targets and task.kind in KINDS:
        result[task.kind] = KINDS[task.kind](log, body, task, log.targets[0].stamp)
    return result


def _early_end(log, task):
    """Time and text of a landing or stop before the end of the task; (inf, '') for none."""
    # If the task is unknown or ends with the loss of control, only a landing with a fault counts.
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
    speed = reduced(np.max, np.linalg.norm(body.velocity[near], axis=1))
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
    return {'joint_error_mean_rad': reduced(np.mean, error),
            'joint_error_std_rad': reduced(np.std, error),
            'joint_error_hover_mean_rad': reduced(
                np.mean, error[inside(log.joint.t[joint], windows)]),
            'thrust_mean_N': reduced(np.mean, used), 'thrust_std_N': reduced(np.std, used),
            'thrust_hover_mean_N': reduced(np.mean, thrust[inside(stamps, windows)]),
            'thrust_max_N': reduced(np.max, used),
            'hover_command_change_rms': {'joint_rad': reduced(_rms, change[:, :4]),
                                         'thrust_N': reduced(_rms, change[:, 4:])},
            'hover_speed_mean_m_s': reduced(np.mean, speed),
            'hover_speed_std_m_s': reduced(np.std, speed),
            'hover_angular_speed_mean_rad_s': reduced(np.mean, rate),
            'hover_angular_speed_std_rad_s': reduced(np.std, rate)}
