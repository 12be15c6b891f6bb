"""
The 3D lemniscate of the publication: a figure of eight with varying height and attitude.

With the phase phi, one round of which is 2 pi, and theta = phi + pi / 2:
    x = A cos(theta),  y = A sin(2 theta) / 2,  z = H + C sin(2 theta + pi / 2)
    roll = -D sin(2 theta),  pitch = D cos(theta),  yaw = pi / 2 (1 - sin(theta))
The curve and its numbers are those of the authors' code (`LemniscateTrajOmni` in
https://github.com/jsk-ros-pkg/jsk_aerial_robot). Yaw is within [0, pi] there; the publication
states [0, 2 pi]. In addition, the phase starts and ends at rest here: its rate follows a quintic
smoothstep over the ramps before the first and after the last round, so all rounds have the same
speed.
"""

from math import cos, pi, sin

import numpy as np

from beetle_omni_ros.control.base import Reference, TrajectoryTarget
from beetle_omni_ros.robot import rotations

LENGTH = 1.0  # [m] A, half the extent in x, and the extent in y
HEIGHT = 1.0  # [m] H, mean height
RISE = 0.3  # [m] C, half the extent in z
TILT = 0.5  # [rad] D, largest roll and pitch
PERIOD = 20.0  # [s] of one round
ROUNDS = 5
RAMP = 4.0  # [s] from rest to full speed
DURATION = 2 * RAMP + ROUNDS * PERIOD  # [s]
SAMPLE_PERIOD = 0.02  # [s] between the samples of the published trajectory


def phase(time: float) -> tuple[float, float]:
    """Return phase [rad], 0 at the begin of round one, and rate [rad/s] at ``time`` [s]."""
    rate = 2 * pi / PERIOD
    if time < RAMP:
        return -_ramp_phase(RAMP, rate) + _ramp_phase(max(time, 0.0), rate), \
            rate * _smoothstep(time / RAMP)
    rest = DURATION - time
    if rest < RAMP:
        total = 2 * pi * ROUNDS + _ramp_phase(RAMP, rate)
        return total - _ramp_phase(max(rest, 0.0), rate), rate * _smoothstep(rest / RAMP)
    return rate * (time - RAMP), rate


def _smoothstep(s):
    s = min(max(s, 0.0), 1.0)
    return s ** 3 * (10 - 15 * s + 6 * s * s)


def _ramp_phase(time, rate):
    """Integral of ``rate * smoothstep`` over the ramp, from rest."""
    s = time / RAMP
    return rate * RAMP * s ** 4 * (2.5 - 3 * s + s * s)


def sample(time: float) -> Reference:
    """Return pose and velocity in world and body rates at ``time`` since the start [s]."""
    phi, rate = phase(time)
    once, twice = phi + pi / 2, 2 * phi + pi
    position = np.array([LENGTH * cos(once), LENGTH / 2 * sin(twice),
                         HEIGHT + RISE * sin(twice + pi / 2)])
    velocity = rate * np.array([-LENGTH * sin(once), LENGTH * cos(twice),
                                2 * RISE * cos(twice + pi / 2)])
    roll, pitch, yaw = -TILT * sin(twice), TILT * cos(once), pi / 2 * (1 - sin(once))
    roll_rate, pitch_rate, yaw_rate = rate * np.array([
        -2 * TILT * cos(twice), -TILT * sin(once), -pi / 2 * cos(once)])
    angular_velocity = np.array([  # body rates of R = Rz(yaw) Ry(pitch) Rx(roll)
        roll_rate - yaw_rate * sin(pitch),
        pitch_rate * cos(roll) + yaw_rate * cos(pitch) * sin(roll),
        -pitch_rate * sin(roll) + yaw_rate * cos(pitch) * cos(roll)])
    return Reference(position, rotations.from_rpy(roll, pitch, yaw), velocity, angular_velocity)


def target(start: float) -> TrajectoryTarget:
    """Return the whole trajectory, beginning at ``start`` [s]."""
    times = np.linspace(0.0, DURATION, round(DURATION / SAMPLE_PERIOD) + 1)
    samples = [sample(float(t)) for t in times]
    return TrajectoryTarget(
        times=start + times,
        positions=np.array([s.position for s in samples]),
        quaternions=np.array([s.quaternion for s in samples]),
        velocities=np.array([s.velocity for s in samples]),
        angular_velocities=np.array([s.angular_velocity for s in samples]),
        stamp=start)
