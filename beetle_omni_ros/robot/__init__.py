"""
What the robot is: parameters, dynamics, allocation, rotations, effects.

Called, ``beetle_omni_ros.robot(file)`` reads a robot file: it is also a function of the public
module.
"""

import sys
from types import ModuleType


class _Room(ModuleType):
    """The room, which reads a robot file when it is called."""

    def __call__(self, file=None):
        """
        Read a robot file.

        Args:
            file: path; None for the shipped params/robot.yaml.

        Returns:
            :class:`~beetle_omni_ros.robot.parameters.RobotParameters`; ``dataclasses.replace``
            makes another robot of it.

        Raises:
            ParameterError: file, key and what was expected, in one line.

        """
        from beetle_omni_ros.robot.parameters import RobotParameters
        return RobotParameters.load(file)


sys.modules[__name__].__class__ = _Room
