"""Driving by hand: keys, sticks and words to target poses. No ROS here."""
