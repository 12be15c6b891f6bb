"""Drivers of the servo bus and of the motor board, without ROS."""
