"""All checks of one recording, and repairs."""

import numpy as np

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording
from beetle_omni_ros.identify.recording.actuator_conventions import joint_damages, thrust_damages
from beetle_omni_ros.identify.recording.clocks import clock_damages
from beetle_omni_ros.identify.recording.conventions import body_damages
from beetle_omni_ros.identify.recording.damage import Damage
from beetle_omni_ros.identify.recording.lags import lag_damages
from beetle_omni_ros.identify.recording.limits import RecordingLimits, shipped
from beetle_omni_ros.identify.recording.motion import motion_of
from beetle_omni_ros.identify.recording.readings import noise_damages, reading_damages
from beetle_omni_ros.robot.parameters import RobotParameters

MOST_REPAIRS = 6        # successive; a repair can reveal another damage


def damages(recording: Recording, robot: RobotParameters,
            limits: RecordingLimits | None = None) -> list[Damage]:
    """
    Check a recording with every topic of ``NEEDED`` by redundant signals.

    Of the robot file, only geometry, servos and joint limits are used.

    Returns:
        damages of the most fundamental kind only, because jumping values and wrong clocks hide
        wrong units and axes. Empty for a valid recording.

    """
    limits = limits or shipped()
    if min(len(recording.times[topic]) for topic in NEEDED) < 2:
        return []
    found = clock_damages(recording, limits)
    found += reading_damages(recording, limits, robot, {damage.topic for damage in found})
    return found or lag_damages(recording, limits) \
        or _convention_damages(recording, robot, limits) or noise_damages(recording, limits)


def _convention_damages(recording, robot, limits):
    m = motion_of(recording, robot, limits)
    if m is None:
        return []
    with np.errstate(all='ignore'):
        return body_damages(recording, m, robot, limits) \
            or joint_damages(recording, m, robot, limits) \
            or thrust_damages(recording, m, robot, limits)


def repaired(recording: Recording, robot: RobotParameters,
             limits: RecordingLimits | None = None) -> tuple[Recording, list[str], list[Damage]]:
    """
    Apply certain corrections until none is left; see :func:`damages`.

    Returns:
        corrected recording, descriptions of the corrections, remaining damages.

    """
    done: list[str] = []
    for _ in range(MOST_REPAIRS):
        found = damages(recording, robot, limits)
        for damage in found:
            if damage.repair is not None:
                recording = damage.repair(recording)
                done.append(f'{damage.text}; corrected: {damage.fix}')
                break
        else:
            break
    else:
        found = damages(recording, robot, limits)
    return recording, done, found
