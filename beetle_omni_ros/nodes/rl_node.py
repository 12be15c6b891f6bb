"""The trained policy as a node."""

from __future__ import annotations

from dataclasses import dataclass

from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.controller_node import ControllerNode
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class RlNodeParameters(PolicyParameters):
    """Parameters of rl_node: the controller's own, the robot, and the file to start from."""

    robot_file: str = parameter(
        '', doc='robot file that the policy shall fly; empty: the shipped one', read_only=True)
    rl_file: str = parameter(
        '', doc='controller file; empty: the shipped params/rl.yaml', read_only=True)


class RlNode(ControllerNode):
    """Publishes rl/command, stamped with the state that it answers."""

    def __init__(self):
        """Load the policy and compare it with robot and package."""
        super().__init__('rl', RlNodeParameters, 'params/rl.yaml', 'rl_file')

    def make_controller(self, parameters):
        """Build the controller around the policy."""
        robot = RobotParameters.load(parameters.robot_file or None)
        return PolicyController(robot, parameters)


def main(args=None):
    """Run the node."""
    runner.main(RlNode, args)


if __name__ == '__main__':
    main()
