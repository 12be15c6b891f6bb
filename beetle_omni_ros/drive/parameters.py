"""Parameters of driving by hand: limits of the target, axes, buttons, named poses."""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.schema import parameter, ParameterError, ParameterFile
from beetle_omni_ros.robot.yaml_file import quoted

BUTTONS = ('arm', 'land', 'hold', 'home')


@dataclass(frozen=True, kw_only=True)
class DriveParameters(ParameterFile, file='drive.yaml'):
    """Content of params/drive.yaml."""

    speed: float = parameter(doc='largest speed of the target', unit='m/s', low=0.01, high=5)
    rate: float = parameter(doc='largest rate of the target attitude', unit='rad/s', low=0.01,
                            high=10)
    leash: float = parameter(doc='distance from the robot at which the target waits', unit='m',
                             low=0.05, high=5)
    step: float = parameter(doc='shift by one key', unit='m', low=0.001, high=1)
    turn: float = parameter(doc='rotation by one key', unit='rad', low=0.001, high=1.6)
    dead_zone: float = parameter(doc='deflection of a joystick axis that counts as none', low=0,
                                 high=0.9)
    joystick_timeout: float = parameter(doc='time without a message after which the joystick '
                                        'counts as released', unit='s', low=0.05, high=10)
    axes: np.ndarray = parameter(doc='axes of sensor_msgs/Joy for x, y, z, yaw, pitch, roll; '
                                 '-1: none', low=-1, high=63, shape=(6,))
    signs: np.ndarray = parameter(doc='signs of these axes', low=-1, high=1, shape=(6,))
    buttons: dict = parameter(doc='arm, land, hold, home -> number of the button')
    poses: dict = parameter(doc='name -> x, y, z [m], roll, pitch, yaw [deg]')

    def __post_init__(self):
        """Check buttons and poses."""
        for name, number in self.buttons.items():
            if name not in BUTTONS or not isinstance(number, int) or not 0 <= number < 64:
                raise ParameterError(f"key 'buttons.{name}': expected {', '.join(BUTTONS)} with "
                                     f'a number from 0 to 63, found {quoted(number)}')
        check_poses(self.poses, "key 'poses.")


def check_poses(poses: dict, where: str) -> None:
    """Check names and values of named poses; raises ParameterError."""
    for name, pose in poses.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ParameterError(f"{where}{name}': expected a name of letters and digits")
        if not isinstance(pose, (list, tuple)) or len(pose) != 6 or not all(
                isinstance(one, (int, float)) and isfinite(one) for one in pose):
            raise ParameterError(f"{where}{name}': expected six numbers x, y, z [m], roll, pitch, "
                                 f'yaw [deg], found {quoted(pose)}')


def read_named_poses(path: str | Path) -> dict:
    """
    Read named poses: a YAML file with ``name: [x, y, z, roll, pitch, yaw]`` [m, deg].

    Raises:
        ParameterError: unusable file or pose; the message has file and name.

    """
    poses = schema.load_yaml(path)
    check_poses(poses, f"{path}: key '")
    return poses
