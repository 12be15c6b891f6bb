"""Damaged IMU samples."""

from __future__ import annotations

import numpy as np

from gap_damage_kinds.kind import damage
from gap_damage_kinds.recording import IMU


@damage('gyroscope in deg/s', IMU, causes=[r'deg(ree)?s?\b'])
def gyroscope_degrees(bag, random, other):
    """Rates times 57.3."""
    bag.put(IMU, bag.values(IMU) * [1, 1, 1, *np.full(3, np.degrees(1))])


@damage('accelerometer in g', IMU, causes=[
    r'\bin g\b', r"units? of g\b|\bg units?\b|'g'|\(g\)|m/s.{0,3} in place of g",
    ('gravit|9\\.8', 'unit|factor|scale')])
def accelerometer_g(bag, random, other):
    """Specific force over 9.80665."""
    bag.put(IMU, bag.values(IMU) / [9.80665, 9.80665, 9.80665, 1, 1, 1])


@damage('accelerometer with the opposite sign', IMU, causes=[
    ('accelero|specific force|imu|force', 'sign|negat|revers|invert|opposite|convention')])
def accelerometer_sign(bag, random, other):
    """Gravity counted downwards."""
    bag.put(IMU, bag.values(IMU) * [-1, -1, -1, 1, 1, 1])
