"""Detectors: named faults, detection times, and no false alarms in healthy motion."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ALL_HEALTHY, Allocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import NUMPY, Servo, Step
from beetle_omni_ros.supervisor import readings, wrench
from beetle_omni_ros.supervisor.detectors import FaultWatch
from beetle_omni_ros.supervisor.readings import JointWatch, SpeedWatch
from beetle_omni_ros.supervisor.wrench import ContactWatch, WrenchWatch

ROBOT = RobotParameters.load()
ALLOCATOR = Allocator(ROBOT)
TICK = 0.005
LAG = ROBOT.rotors.time_constant
LAGS = np.linspace(*ROBOT.interval('rotors.time_constant'), 4)
MEASURED = RobotParameters.load('measured')


def jumps(seed, duration, low, high, shortest, longest):
    """Four commands for each tick that jump at random times."""
    random, ticks = np.random.default_rng(seed), round(duration / TICK)
    made = np.empty((ticks, 4))
    for joint in range(4):
        times = np.cumsum(random.uniform(shortest, longest, round(duration / shortest) + 1))
        values = random.uniform(low, high, len(times) + 1)
        made[:, joint] = values[np.searchsorted(times, TICK * np.arange(ticks))]
    return made


class Body:
    """A free body moved by its thrusts; the IMU has the noise of the simulator."""

    def __init__(self, attitude, seed=0, lag=LAG):
        self.lag = lag
        self.hover = ALLOCATOR.hover(attitude, np.zeros(4))
        self.thrust, self.rate = self.hover.thrust.copy(), np.zeros(3)
        self.random, self.time = np.random.default_rng(seed), 0.0
        self.command = Command(0.0, self.hover.tilt, self.hover.thrust)
        self.surprise = 0.0     # largest unexplained force [m/s^2]

    def feed(self, watch, duration, works=np.ones(4), turn=np.zeros(4), push=np.zeros(3),
             asked=None):
        """
        Feed the watch for a time; return the time of the first named fault [s], or None.

        The thrusts ``asked`` of each tick are by default those of hover.
        """
        for k in range(round(duration / TICK)):
            self.time += TICK
            thrust = self.hover.thrust if asked is None else asked[k]
            self.thrust += -np.expm1(-TICK / self.lag) * (works * thrust - self.thrust)
            force, torque = ALLOCATOR.wrench(self.hover.tilt + turn, self.thrust)
            self.rate = self.rate + TICK * (torque - np.cross(
                self.rate, ROBOT.inertia * self.rate)) / ROBOT.inertia
            noise = self.random.normal(size=6) * [*[0.05] * 3, *[0.005] * 3]
            watch.on_imu(self.time, (force + push) / ALLOCATOR.mass + noise[:3],
                         self.rate + noise[3:], self.hover.tilt, thrust, ALL_HEALTHY)
            self.surprise = max(self.surprise, float(np.linalg.norm(watch.unexplained)))
            if watch.lost is not None:
                return (k + 1) * TICK
        return None


def wrench_watch():
    return WrenchWatch(ROBOT, ALLOCATOR)


ATTITUDES = [rotations.from_rpy(0, 0, 0), rotations.from_rpy(0.6, -0.3, 1.0),
             rotations.from_rpy(2.9, 0.2, 0.4)]


@pytest.mark.parametrize('attitude', ATTITUDES)
@pytest.mark.parametrize('rotor', range(4))
def test_a_lost_rotor_is_named_within_a_sixth_of_a_second(attitude, rotor):
    body, watch = Body(attitude), wrench_watch()
    assert body.feed(watch, 2.0) is None
    works = np.ones(4)
    works[rotor] = 0.0
    watch.supported = np.arange(4) == rotor     # which its ESC reports soon
    assert body.feed(watch, 0.5, works) <= 0.16
    assert watch.lost == rotor


@pytest.mark.parametrize('lag', LAGS)
def test_no_lag_of_the_robot_file_leaves_an_unexplained_force(lag):
    body, watch = Body(ATTITUDES[0], lag=lag), wrench_watch()
    assert body.feed(watch, 0.5) is None
    watch.supported = np.ones(4, dtype=bool)
    together = jumps(1, 4.0, 3.0, 15.0, 0.05, 0.4)[:, :1] * np.ones(4)
    assert body.feed(watch, 4.0, asked=together) is None
    assert body.surprise < 3 * wrench.FORCE_NOISE
    works = np.array([1, 0, 1, 1])
    assert body.feed(watch, 0.5, works) < 0.2 and watch.lost == 1


@pytest.mark.parametrize('rotor', range(4))
def test_a_loss_of_two_fifths_is_a_lost_rotor_if_it_lasts(rotor):
    body, watch = Body(ATTITUDES[1], seed=rotor), wrench_watch()
    assert body.feed(watch, 2.0) is None
    works = np.where(np.arange(4) == rotor, 0.6, 1.0)
    assert wrench.STEADY_TIME < body.feed(watch, 4.0, works) < 3.0
    assert watch.lost == rotor


def test_a_weaker_rotor_and_an_external_push_are_not_a_lost_rotor():
    body, watch = Body(ATTITUDES[0]), wrench_watch()
    assert body.feed(watch, 4.0, works=np.array([0.8, 1, 1, 1])) is None
    body, watch = Body(ATTITUDES[0]), wrench_watch()
    assert body.feed(watch, 2.0, push=np.array([20.0, 0, 0])) is None
    assert np.linalg.norm(watch.unexplained) == pytest.approx(20.0 / ALLOCATOR.mass, rel=0.05)


def test_contact_is_detected_by_impact_or_by_a_push_near_the_ground():
    watch, contact = wrench_watch(), ContactWatch(ROBOT.gravity)
    watch.impact = 80.0
    contact.update(TICK, 1.5, watch)
    assert not contact.reason
    contact.update(TICK, 0.1, watch)
    assert 'impact' in contact.reason
    contact = ContactWatch(ROBOT.gravity)
    watch.impact, watch.unexplained = 0.0, np.array([0, 0, 0.6 * ROBOT.gravity])
    for height, named in ((1.0, False), (None, False), (0.1, True)):
        for _ in range(round(2 * wrench.SUPPORT_TIME / TICK)):
            contact.update(TICK, height, watch)
        assert bool(contact.reason) is named
    for impact in (10.0, 0.9 * wrench.IMPACT * 4 * ROBOT.rotors.thrust_max / ALLOCATOR.mass):
        watch = wrench_watch()
        watch.on_imu(0.0, np.array([0, 0, impact]), np.zeros(3), np.zeros(4), np.zeros(4),
                     ALL_HEALTHY)
        assert watch.impact == 0.0


def follow(watch, asked, follows, delay, robot):
    """
    Move the servos of a robot for 8 s by ``asked(t)``; ``follows(tilt)`` adds a fault.

    Returns:
        time at which the watch names the first fault [s], or None.

    """
    random, tilt, rate = np.random.default_rng(1), np.zeros(4), np.zeros(4)
    friction = robot.effects['joint_friction']
    servo = Step(NUMPY, Servo.of(robot.joints, **{
        name: np.array(value) for name, value in friction.items()}), TICK)
    for t in TICK * np.arange(round(8.0 / TICK)):
        watch.commands.append((t, asked(t)))
        tilt, rate = servo(asked(t - delay), tilt, rate)
        watch.on_joints(t, follows(tilt) + 0.005 * random.uniform(-1, 1, 4))
        if any(watch.astray) or any(watch.jump):
            return t
    return None


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('known', [ROBOT, MEASURED], ids=['shipped file', 'measured file'])
def test_a_servo_within_the_intervals_is_never_named_and_a_frozen_one_is(known, seed):
    asked = jumps(seed, 8.0, -2.0, 2.0, 0.03, 0.8)
    drawn = MEASURED.drawn(np.random.default_rng(seed))
    delay = readings.DELAY + drawn.command_delays[0]

    def command(t):
        return asked[max(0, round(t / TICK))]

    assert follow(JointWatch(known), command, lambda q: q, delay, drawn) is None
    watch = JointWatch(known)
    first = follow(watch, command, lambda q: np.where(np.arange(4) == 1, 1.5, q), delay, drawn)
    assert first < 1.5 and watch.astray[1]


def esc(lag, asked, works, noise=0.0, seed=0):
    """
    Speeds of rotors with a lag [s], of which after 4 s only the shares ``works`` are left.

    Returns:
        the watch, time from the fault until it is named [s] or None, and the time at which a rotor
        is noticed as slow.

    """
    watch, thrust, noticed = SpeedWatch(ROBOT), asked[0].copy(), None
    random = np.random.default_rng(seed)
    for k, command in enumerate(asked):
        t = TICK * k
        share = works if t > 4.0 else np.ones(4)
        thrust = thrust - np.expm1(-TICK / lag) * (share * asked[max(0, k - 2)] - thrust)
        watch.commands.append((t, command))
        if k % 4 == 0:
            watch.on_speeds(t, 300.0 * np.sqrt(thrust) * random.normal(1.0, noise, 4))
            if noticed is None and any(watch.slow):
                noticed = t - 4.0
            if watch.lost is not None or watch.deaf is not None:
                return watch, t - 4.0, noticed
    return watch, None, noticed


@pytest.mark.parametrize('seed, lag', list(enumerate(LAGS)))
def test_no_lag_of_the_robot_file_makes_a_rotor_suspect(lag, seed):
    asked = jumps(seed, 8.0, 2.0, 14.0, 0.02, 0.5)
    _, named, noticed = esc(lag, asked, np.ones(4), 0.01, seed)
    assert named is None and noticed is None
    watch, named, _ = esc(lag, asked, np.array([1, 0.4, 1, 1]), 0.01, seed)
    assert watch.lost == 1 and 0 < named < 1.0


@pytest.mark.parametrize('stall', [0.1, 0.3])
def test_no_rotor_is_suspected_after_a_stall_of_the_motor_board(stall):
    watch, thrust = SpeedWatch(ROBOT), np.full(4, 7.0)
    asked = np.full(4, 7.0)
    for n in range(2000):
        t = 0.005 * n
        stalled = 3.0 < t % 4.0 < 3.0 + stall       # commands and reports wait
        # Just before the stall one pair of rotors is raised, in the stall the other.
        wanted = 7.0 + np.where(2.95 < t % 4.0 < 3.05, 5.0, -5.0) * np.array([1, -1, 1, -1])
        if not stalled:
            asked = wanted
        thrust = thrust - np.expm1(-0.005 / LAG) * (asked - thrust)
        watch.commands.append((t, wanted))
        if n % 4 == 0 and not stalled:
            watch.on_speeds(t, 300.0 * np.sqrt(np.maximum(thrust, 0.0)))
            assert watch.lost is None and watch.deaf is None


def test_the_zero_of_an_encoder_that_jumps_moves_and_the_joint_is_not_stuck():
    watch = FaultWatch(ROBOT, Allocator(ROBOT))
    for n in range(200):
        t = 0.005 * n
        true = np.full(4, 0.3 * np.sin(3 * t))
        zero = np.array([0, 0, 1.5, 0]) if n > 100 else np.zeros(4)
        watch.on_command(Command(t, watch.health.read(true), np.full(4, 7.0)))
        watch.on_joints(t, true + zero, True)
    assert set(watch.faults) == {'joint3_encoder_jump'}
    assert watch.health.healthy
    np.testing.assert_allclose(watch.health.zeros, [0, 0, 1.5, 0], atol=0.01)


@pytest.mark.parametrize('sticks', [True, False], ids=['holds its thrust', 'stops'])
def test_a_rotor_that_gives_more_thrust_than_asked_is_deaf_and_not_lost(sticks):
    watch, tilt, rotor = FaultWatch(ROBOT, ALLOCATOR), np.zeros(4), np.arange(4) == 2
    thrust, rate = np.full(4, 7.0), np.zeros(3)
    for n in range(800):
        t = TICK * n
        asked = np.where(rotor & (t > 2.0), 2.0, 7.0 + np.sin(6.0 * t))
        follows = np.where(rotor & (t > 2.0), 7.0 if sticks else 0.0, asked)
        thrust = thrust - np.expm1(-TICK / LAG) * (follows - thrust)
        force, torque = ALLOCATOR.wrench(tilt, thrust)
        rate = rate + TICK * (torque - np.cross(rate, ROBOT.inertia * rate)) / ROBOT.inertia
        command = Command(t, tilt, asked)
        watch.on_command(command)
        if n % 4 == 0:
            watch.on_speeds(t, 300.0 * np.sqrt(thrust))
        watch.on_imu(t, force / ALLOCATOR.mass, rate, tilt, 1.0)
        if watch.faults:
            break
    assert list(watch.faults) == ['rotor3_deaf' if sticks else 'rotor3_lost']
    assert watch.health.rotors[2] == sticks
    assert watch.health.held[2] == (pytest.approx(7.0, abs=1.5) if sticks else None)


@pytest.mark.parametrize(('height', 'roll', 'crashed'), [
    (0.1, 0.2, False), (1.0, 1.0, False), (0.1, 1.0, True)])
def test_without_imu_a_tipped_robot_at_the_floor_is_a_crash(height, roll, crashed):
    contact = ContactWatch(ROBOT.gravity)
    contact.on_pose(rotations.from_rpy(roll, 0, 0), height)
    assert bool(contact.reason) == crashed
