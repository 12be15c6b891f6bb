"""What a film shows, sampled at the times of its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.robot.allocation import hover_allocation
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import errors, geodesic_angles, hold, Motion, motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.sim.render import Pose

SETTLED = 0.5           # [deg] of roll, pitch and yaw that a caption leaves out


@dataclass(frozen=True)
class Scene:
    """
    One panel of a film, F frames long.

    Attributes:
        label: its heading.
        colour: of heading, path and curve, '#rrggbb'.
        poses: (F,) of the robot.
        ghosts: (F,) of the target, or of what a model expects; None where there is none.
        position: (F,) distance between both [m], NaN without a ghost.
        orientation: (F,) angle between both [deg].
        notes: (F,) what the robot is told, in words.
        against_model: the ghost is a model's, not the target.

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
    """Show a flight and its targets at ``times`` (F,) on the clock of the flight [s]."""
    body, aims = _at(motion(log), times), _aims(log, times)
    ghosts: list[Pose | None] = []
    position, orientation = np.full(len(times), np.nan), np.full(len(times), np.nan)
    tilts: dict[bytes, np.ndarray] = {}
    for k, aim in enumerate(aims):
        if aim is None:
            ghosts.append(None)
            continue
        now = slice(k, k + 1)
        position[k], orientation[k] = (float(e[0]) for e in errors(body, aim, now))
        wanted = aim if isinstance(aim, PoseTarget) else aim.at(float(times[k]))
        key = np.round(wanted.quaternion, 4).tobytes()
        if key not in tilts:
            tilts[key] = hover_allocation(robot, wanted.quaternion, np.zeros(4)).tilt
        ghosts.append(Pose(wanted.position, wanted.quaternion, tilts[key], time=times[k]))
    return Scene(label, colour, _flown(log, body), ghosts, position, orientation,
                 [_words(aim) for aim in aims])


def model_scene(log: FlightLog, label: str, colour: str, times: np.ndarray,
                expected: Motion) -> Scene:
    """Show a flight and what a model expected of it, see :func:`.free_runs.free_runs`."""
    body, model = _at(motion(log), times), _at(expected, times)
    poses = _flown(log, body)
    ghosts: list[Pose | None] = [Pose(position, quaternion, pose.tilt, time=pose.time)
              for position, quaternion, pose in zip(model.position, model.quaternion, poses,
                                                    strict=True)]
    return Scene(label, colour, poses, ghosts,
                 np.linalg.norm(model.position - body.position, axis=1),
                 np.degrees(geodesic_angles(model.quaternion, body.quaternion)),
                 [_words(aim) for aim in _aims(log, times)], against_model=True)


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


def _aims(log, times) -> list[Target | None]:
    stamps = np.array([target.stamp for target in log.targets])
    index = np.searchsorted(stamps, times + 1e-6, side='right') - 1
    return [log.targets[k] if k >= 0 else None for k in index]


def _words(aim):
    if aim is None:
        return ''
    if not isinstance(aim, PoseTarget):
        return 'follow the trajectory'
    x, y, z, w = aim.quaternion
    roll = np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    pitch = np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    turns = [f'{name} {abs(angle) if abs(angle) > 179.5 else angle:.0f}°'
             for name, angle in (('roll', roll), ('pitch', pitch), ('yaw', yaw))
             if abs(angle) > SETTLED]
    text = 'go to ' + '  '.join(f'{v:.1f}' for v in aim.position) + ' m' \
        + (', ' + ' '.join(turns) if turns else ', level')
    return text.replace('-', '−')
