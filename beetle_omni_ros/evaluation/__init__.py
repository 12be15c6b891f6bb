"""The flight stack in one process: the nodes' parts, without ROS, faster than real time."""
