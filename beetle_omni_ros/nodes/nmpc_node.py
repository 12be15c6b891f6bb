"""The model-predictive controller as a node."""

from __future__ import annotations

from dataclasses import dataclass

from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.controller_node import ControllerNode
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class NmpcNodeParameters(NmpcParameters):
    """Parameters of nmpc_node: the controller's own, the robot, and the file to start from."""

    robot_file: str = parameter(
        '', doc='robot file that the controller believes; empty: the shipped one',
        read_only=True)
    nmpc_file: str = parameter(
        '', doc='controller file; empty: the shipped params/nmpc.yaml', read_only=True)


class NmpcNode(ControllerNode):
    """Publishes nmpc/command, stamped with the state that it answers."""

    def __init__(self):
        """Load (and compile, the first time) the controller."""
        super().__init__('nmpc', NmpcNodeParameters, 'params/nmpc.yaml', 'nmpc_file')

    def make_controller(self, parameters):
        """Build the NMPC."""
        robot = RobotParameters.load(parameters.robot_file or None)
        return NmpcController(robot, parameters)


def main(args=None):
    """Run the node."""
    runner.main(NmpcNode, args)


if __name__ == '__main__':
    main()
