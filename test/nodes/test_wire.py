"""Round trips of messages and values, and refusals of bad messages."""

from builtin_interfaces.msg import Time
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.values import HealthReport, MessageError, Odom, TargetOverride
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.readings import ImuReading, JointReading, PoseReading, RotorReading


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def over_the_wire(message):
    return deserialize_message(serialize_message(message), type(message))


def unit(rng):
    return rotations.normalized(rng.normal(size=4))


def time_message(stamp):
    message = Time()
    conversions.set_time(message, stamp)
    return message


def test_stamps_round_trip_to_the_nanosecond():
    for stamp in (0.0, 1e-9, 1.999999999, 1_790_000_000.123456789):
        assert conversions.seconds(time_message(stamp)) == pytest.approx(stamp, abs=3e-7)
    assert time_message(2 - 1e-12).nanosec == 0      # rounds up into the next second


@pytest.mark.parametrize('kind', [float, np.float32, int])
def test_scalars_of_any_number_type_arrive_as_sent(kind):
    values = [kind(1), kind(2), kind(3)]
    message = over_the_wire(wire.message('imu/data_raw', ImuReading(4.0, values, values)))
    sample = conversions.take_imu(message)
    assert sample.specific_force.tolist() == [1, 2, 3]
    assert sample.angular_velocity.tolist() == [1, 2, 3]
    assert message.orientation_covariance[0] == -1


def test_command_round_trip_and_layout(rng):
    command = Command(12.5, rng.normal(size=4), rng.uniform(0, 20, size=4).astype(np.float32))
    message = over_the_wire(wire.message('command', command))
    assert list(message.name) == [f'gimbal{k}' for k in '1234'] + [f'rotor{k}' for k in '1234']
    assert np.isnan(message.position[4:]).all() and np.isnan(message.effort[:4]).all()
    assert len(message.velocity) == 0
    back = conversions.take_command(message)
    assert np.array_equal(back.tilt, command.tilt)
    assert np.array_equal(back.thrust, command.thrust)
    assert back.stamp == pytest.approx(12.5)


def test_joints_are_found_by_name_not_by_position(rng):
    position = rng.normal(size=4)
    message = wire.message('joint_states', JointReading(1.0, position, -position))
    shuffled = JointState(name=[message.name[k] for k in (2, 0, 3, 1)],
                          position=[message.position[k] for k in (2, 0, 3, 1)],
                          velocity=[message.velocity[k] for k in (2, 0, 3, 1)])
    assert np.array_equal(conversions.take_joints(shuffled).position, position)
    assert np.array_equal(conversions.take_joints(shuffled).velocity, -position)


def test_rotor_speeds_have_the_names_of_the_rotors():
    message = over_the_wire(wire.message(
        'rotor_states', RotorReading(2.5, np.array([1.0, np.nan, 3, 400]))))
    assert list(message.name) == ['rotor1', 'rotor2', 'rotor3', 'rotor4']
    np.testing.assert_array_equal(message.velocity, [1, np.nan, 3, 400])
    assert not len(message.position) and not len(message.effort)
    assert conversions.seconds(message.header.stamp) == 2.5


def test_odometry_carries_the_twist_in_base_link(rng):
    rotation, velocity, rate = unit(rng), rng.normal(size=3), rng.normal(size=3)
    message = wire.message('odom', Odom(3.0, rng.normal(size=3), velocity, rotation, rate,
                                       np.eye(6), 2 * np.eye(6)))
    twist = over_the_wire(message).twist.twist
    assert np.allclose(rotations.matrix(rotation) @ [twist.linear.x, twist.linear.y,
                                                     twist.linear.z], velocity)
    back = conversions.take_odom(message)
    assert np.allclose(back.velocity, velocity)
    assert np.allclose(back.angular_velocity, rate)
    assert message.twist.covariance[7] == 2


def test_targets_round_trip(rng):
    pose = PoseTarget(rng.normal(size=3), unit(rng), 8.0)
    back = conversions.take_pose_target(over_the_wire(wire.message('target_pose', pose)))
    assert np.allclose(back.quaternion, pose.quaternion) and back.stamp == pytest.approx(8)
    times = 100 + np.cumsum(rng.uniform(0.01, 0.2, size=30))
    path = TrajectoryTarget(times, rng.normal(size=(30, 3)),
                            np.array([unit(rng) for _ in times]), rng.normal(size=(30, 3)),
                            rng.normal(size=(30, 3)), stamp=100.0)
    back = conversions.take_trajectory(over_the_wire(wire.message('target_trajectory', path)))
    for name in ('times', 'positions', 'quaternions', 'velocities', 'angular_velocities'):
        assert np.allclose(getattr(back, name), getattr(path, name), atol=1e-8), name


def test_bad_messages_are_refused_with_a_reason(rng):
    command = wire.message('command', Command(1.0, np.zeros(4), np.full(4, 7.0)))
    command.effort[5] = float('nan')
    with pytest.raises(MessageError, match='thrust is not finite'):
        conversions.take_command(command)
    with pytest.raises(MessageError, match='names are not'):
        conversions.take_command(JointState(name=['gimbal1'], position=[0.0]))
    with pytest.raises(MessageError, match='too few'):
        conversions.take_joints(JointState(name=['gimbal1', 'gimbal2', 'gimbal3', 'gimbal4'],
                                           position=[0.0]))
    with pytest.raises(MessageError, match='unit quaternion'):
        conversions.take_pose_target(wire.message(
            'target_pose', PoseTarget(np.zeros(3), [0, 0, 0, 0.9], 0.0)))
    with pytest.raises(MessageError, match='position is not finite'):
        conversions.take_pose(wire.message(
            'mocap/pose', PoseReading(0.0, [0, float('inf'), 0], [0, 0, 0, 1])))


def test_messages_of_the_supervisor_round_trip():
    way = TrajectoryTarget(np.array([5.0, 6.0]), np.zeros((2, 3)), np.tile([0, 0, 0, 1.0], (2, 1)),
                           np.zeros((2, 3)), np.zeros((2, 3)), stamp=5.0)
    value = conversions.take_override(wire.message('supervisor/target', TargetOverride.of(way)))
    assert value.stamp == 5.0 and np.allclose(value.target.times, way.times)
    none = wire.message('supervisor/target', TargetOverride.of(None))
    assert conversions.take_override(none).target is None
    health = ActuatorHealth((True, False, True, True), (None, 0.4, None, None))
    message = wire.message('supervisor/actuators', HealthReport(7.0, health))
    assert conversions.read_health(message) == HealthReport(7.0, health)
    message.position[1] = np.inf
    with pytest.raises(MessageError):
        conversions.read_health(message)
    speeds = JointState(name=['rotor1', 'rotor2', 'rotor3', 'rotor4'],
                        velocity=[1.0, 2.0, 3.0, np.nan])
    speeds.header.stamp = time_message(3.0)
    value = conversions.read_rotors(speeds)
    assert value.stamp == 3.0 and value.speed[2] == 3.0
