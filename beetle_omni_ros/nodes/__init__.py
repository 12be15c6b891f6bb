"""rclpy nodes: adapters between messages and the pure core."""
