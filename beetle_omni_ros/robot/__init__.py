"""
Model of the robot: parameters, dynamics, allocation, rotations, effects.

The package is also callable, as a function of the public interface:
``beetle_omni_ros.robot(file)`` reads a robot file.
"""

import sys
from types import ModuleType


class _CallableModule(ModuleType):

    def __call__(self, file=None):
        """
        Read a robot file, by default the shipped params/robot.yaml.

        ``dataclasses.replace`` derives another robot from the result,
        :class:`~beetle_omni_ros.robot.parameters.RobotParameters`.
        """
        from beetle_omni_ros.robot.parameters import RobotParameters
        return RobotParameters.load(file)


sys.modules[__name__].__class__ = _CallableModule
