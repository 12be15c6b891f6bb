"""Content of the panels of a film, sampled at the times of its frames."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import hover_allocation
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import errors, geodesic_angles, hold, Motion, motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.sim.render import Pose

SETTLED = 0.5           # [deg] smaller roll, pitch and yaw are left out in captions


@dataclass(frozen=True)
class Scene:
    """
    One panel of a film with F frames.

    Attributes:
        label: heading.
        colour: colour of heading, path and curve, '#rrggbb'.
        poses: (F,) poses of the robot.
        ghosts: (F,) poses of the target or of the model's prediction, or None.
        position: (F,) distance between pose and ghost [m], NaN without a ghost.
        orientation: (F,) angle between pose and ghost [deg], NaN without a ghost.
        notes: (F,) target in words.
        against_model: whether the ghosts are a model's prediction.

    """

    label: str
    colour: str
    poses: list[Pose]
    ghosts: list[Pose | None]
    position: np.ndarray
    orientation: np.ndarray
    notes: list[str]
    against_model: bool = False


def target_scene(log: FlightLog, label: str, colour: str, times: np.ndarray,
                 robot: RobotParameters) -> Scene:
    """Scene of a flight and its targets at ``times`` (F,) on the clock of the flight [s]."""
    body, targets = _at(motion(log), times), _targets_at(log, times)
    ghosts: list[Pose | None] = []
    position, orientation = np.full(len(times), np.nan), np.full(len(times), np.nan)
    tilts: dict[bytes, np.ndarray] = {}
    for k, target in enumerate(targets):
        if target is None:
            ghosts.append(None)
            continue
        now = slice(k, k + 1)
        position[k], orientation[k] = (float(e[0]) for e in errors(body, target, now))
        pose = target if isinstance(target, PoseTarget) else target.at(float(times[k]))
        key = np.round(pose.quaternion, 4).tobytes()
        if key not in tilts:
            tilts[key] = hover_allocation(robot, pose.quaternion, np.zeros(4)).tilt
        ghosts.append(Pose(pose.position, pose.quaternion, tilts[key], time=times[k]))
    return Scene(label, colour, _flown(log, body), ghosts, position, orientation,
                 [_in_words(target) for target in targets])


def model_scene(log: FlightLog, label: str, colour: str, times: np.ndarray,
                expected: Motion) -> Scene:
    """Scene of a flight and the motion that :func:`.free_runs.free_runs` predicts."""
    body, model = _at(motion(log), times), _at(expected, times)
    poses = _flown(log, body)
    ghosts: list[Pose | None] = [
        Pose(position, quaternion, pose.tilt, time=pose.time) for position, quaternion, pose
        in zip(model.position, model.quaternion, poses, strict=True)]
    return Scene(label, colour, poses, ghosts,
                 np.linalg.norm(model.position - body.position, axis=1),
                 np.degrees(geodesic_angles(model.quaternion, body.quaternion)),
                 [_in_words(target) for target in _targets_at(log, times)], against_model=True)


def _at(body, times):
    index = np.clip(np.searchsorted(body.t, times - 1e-6), 0, len(body.t) - 1)
    return Motion(times, *(getattr(body, name)[index] for name in
                           ('position', 'quaternion', 'velocity', 'angular_velocity')))


def _flown(log, body):
    count = len(body.t)
    tilt = hold(log.joint_t, log.joint_position, body.t) if len(log.joint_t) else \
        hold(log.command_t, log.command_tilt, body.t) if len(log.command_t) else \
        np.zeros((count, 4))
    thrust = hold(log.command_t, log.command_thrust, body.t) if len(log.command_t) else \
        [None] * count
    return [Pose(*row) for row in zip(body.position, body.quaternion, tilt, thrust, body.t,
                                      strict=True)]


def _targets_at(log, times) -> list[Target | None]:
    stamps = np.array([target.stamp for target in log.targets])
    index = np.searchsorted(stamps, times + 1e-6, side='right') - 1
    return [log.targets[k] if k >= 0 else None for k in index]


def _in_words(target):
    if target is None:
        return ''
    if not isinstance(target, PoseTarget):
        return 'follow the trajectory'
    angles = np.degrees(rotations.to_rpy(target.quaternion))
    turns = [f'{name} {abs(angle) if abs(angle) > 179.5 else angle:.0f}°'
             for name, angle in zip(('roll', 'pitch', 'yaw'), angles) if abs(angle) > SETTLED]
    text = 'go to ' + '  '.join(f'{v:.1f}' for v in target.position) + ' m' \
        + (', ' + ' '.join(turns) if turns else ', level')
    return text.replace('-', '−')
