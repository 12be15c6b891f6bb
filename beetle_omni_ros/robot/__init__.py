"""What the robot is, free of ROS: parameters, dynamics, allocation, conventions."""
