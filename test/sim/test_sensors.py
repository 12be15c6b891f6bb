"""Sensor readings: noise, resolution, latency and rate, measured at rest and in motion."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.sim import parameters as published
from beetle_omni_ros.sim.parameters import draw
from beetle_omni_ros.sim.sensors import RESOLUTION
from beetle_omni_ros.sim.simulator import Simulator

TICK = WORLD.tick


def at_rest(conditions='nominal', seconds=20, seed=0):
    simulator = Simulator(ROBOT, WORLD, conditions, seed)
    return simulator, [simulator.step() for _ in range(int(seconds / TICK))]


def pose_errors(frames, truths):
    """Position and rotation-vector errors of all MoCap frames against the truth at capture."""
    poses = [frame.mocap for frame in frames if frame.mocap is not None]
    position = np.array([pose.position - truths[pose.stamp].position for pose in poses])
    rotation = (Rotation.from_quat([truths[pose.stamp].quaternion for pose in poses]).inv()
                * Rotation.from_quat([pose.quaternion for pose in poses])).as_rotvec()
    return position, rotation


def agrees(samples, deviation, mean=0.0):
    """Mean and standard deviation of columns within five standard errors."""
    count = len(samples)
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=5 * deviation / np.sqrt(count))
    np.testing.assert_allclose(samples.std(axis=0), deviation, rtol=5 / np.sqrt(2 * count))


def test_nominal_noise_has_its_parameters():
    _, frames = at_rest()
    force = np.array([frame.imu.specific_force for frame in frames])
    rate = np.array([frame.imu.angular_velocity for frame in frames])
    agrees(force, 0.05, [0, 0, ROBOT.gravity])
    agrees(rate, 0.005)
    position, rotation = pose_errors(frames, {f.time: f.truth for f in frames} | {
        0.0: frames[0].truth})
    agrees(position, 0.001)
    agrees(rotation, np.deg2rad(0.1))
    white = np.corrcoef(force[1:, 0], force[:-1, 0])[0, 1]
    assert abs(white) < 5 / np.sqrt(len(force))


def test_rates_and_ages_are_exact_in_ticks():
    _, frames = at_rest(seconds=1)
    assert all(frame.imu.stamp == frame.time for frame in frames)
    assert all(abs(frame.time - frame.joints.stamp - 0.010) < 1e-12 for frame in frames)
    with_mocap = [frame for frame in frames if frame.mocap is not None]
    assert len(with_mocap) == 100
    assert all(abs(f.time - f.mocap.stamp - 0.010) < 1e-12 for f in with_mocap)
    assert np.allclose(np.diff([f.mocap.stamp for f in with_mocap]), 0.010, atol=1e-12)
    assert sum(frame.battery is not None for frame in frames) == 10


def test_readings_equal_the_truth_at_their_stamps():
    """Falling and turning, noise off: old readings equal the old truth."""
    quiet = replace(WORLD, specific_force_noise=0.0, angular_velocity_noise=0.0,
                    position_noise=0.0, orientation_noise=0.0)
    simulator = Simulator(ROBOT, quiet)
    simulator.reset(HIGH, Rotation.from_euler('ZYX', [0.3, 0.2, 0.1]).as_quat())
    simulator.wrench = np.array([1, 2, 3, 0.1, 0.2, -0.1])
    truths = {0.0: simulator.truth}
    for _ in range(60):
        simulator.command(Command(simulator.time, np.array([1.0, -1, 0.5, 0]), np.full(4, 6.0)))
        frame = simulator.step()
        truths[frame.time] = frame.truth
        if frame.mocap:
            np.testing.assert_allclose(frame.mocap.position, truths[frame.mocap.stamp].position)
            np.testing.assert_allclose(frame.mocap.quaternion,
                                       truths[frame.mocap.stamp].quaternion, atol=1e-12)
        then = min(truths, key=lambda t: abs(t - frame.joints.stamp))
        if frame.joints.stamp >= 0:
            count = RESOLUTION
            error = frame.joints.position - truths[then].tilt
            assert np.abs(error).max() <= count / 2 + 1e-12
            turns = frame.joints.position / count
            np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


def test_imu_readings_sum_to_the_motion_even_through_jolts():
    """Strapdown integration of the readings follows the truth during fast tilt motion."""
    quiet = replace(WORLD, specific_force_noise=0.0, angular_velocity_noise=0.0)
    simulator = Simulator(ROBOT, quiet)
    simulator.reset(HIGH)
    attitude = Rotation.from_quat(simulator.truth.quaternion)
    velocity = simulator.truth.velocity
    for k in range(100):
        tilt = np.array([1.5, -1.0, 0.5, 2.0]) * (1 if k % 20 < 10 else -1)
        simulator.command(Command(simulator.time, tilt, np.full(4, 8.0)))
        frame = simulator.step()
        turn = Rotation.from_rotvec(frame.imu.angular_velocity * TICK / 2)
        velocity = velocity + TICK * ((attitude * turn).apply(frame.imu.specific_force)
                                      - [0, 0, ROBOT.gravity])
        attitude = attitude * turn * turn
    np.testing.assert_allclose(velocity, frame.truth.velocity, atol=1e-6)
    assert (attitude.inv() * Rotation.from_quat(frame.truth.quaternion)).magnitude() < 1e-6


def test_published_biases_and_noise_come_from_the_table():
    simulator, frames = at_rest('published', seed=5)
    drawn = simulator.conditions
    position, rotation = pose_errors(frames, {f.time: f.truth for f in frames} | {
        0.0: frames[0].truth})
    agrees(position, np.hypot(0.001, 0.01 / np.sqrt(3)), drawn.position_bias)
    agrees(rotation, np.hypot(np.deg2rad(0.1), 0.01 / np.sqrt(3)), drawn.orientation_bias)
    rate = np.array([frame.imu.angular_velocity for frame in frames])
    agrees(rate, np.hypot(0.005, 0.005 / np.sqrt(3)), drawn.imu_bias[3:])
    tilt = np.array([frame.joints.position for frame in frames])
    agrees(tilt, np.deg2rad(2) / np.sqrt(3), drawn.tilt_bias)
    assert np.all(np.abs(tilt - drawn.tilt_bias) <= published.TILT_NOISE + 2 * np.pi / 4096)


def test_published_draws_fill_their_ranges():
    drawn = [draw('published', WORLD, np.random.default_rng(seed)) for seed in range(400)]
    for values, middle, width in [
            ([d.variation.mass_scale for d in drawn], 1, published.MASS_SCALE),
            ([d.position_bias for d in drawn], 0, published.POSITION_BIAS),
            ([d.tilt_bias for d in drawn], 0, published.TILT_BIAS)]:
        away = np.abs(np.array(values) - middle)
        assert 0.95 * width < away.max() <= width
    assert {round(d.imu_latency / published.LATENCY_UNIT) for d in drawn} == {3, 4, 5}
