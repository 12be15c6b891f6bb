"""ROS node of the model-predictive controller."""

from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.controller_node import ControllerNode


class NmpcNode(ControllerNode):
    """Publishes nmpc/command, stamped with the state that it answers."""

    def __init__(self):
        super().__init__('nmpc')


def main(args=None):
    """Run the node."""
    runner.main(NmpcNode, args)


if __name__ == '__main__':
    main()
