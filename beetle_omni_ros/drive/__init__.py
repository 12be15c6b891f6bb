"""Driving by hand: target poses from keys, joystick axes and typed commands; no ROS."""
