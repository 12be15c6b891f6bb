"""The flight stack in one process without ROS, faster than real time."""
