"""Identification of the tilt servos from response logs: fit, comparison with a robot file."""
