"""The flight stack as components: all rules between topics; no ROS, no threads, no clock."""
