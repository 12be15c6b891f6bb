"""rclpy nodes: one adapter between the topics of a component and ROS."""
