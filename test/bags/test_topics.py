"""The table of topics: nodes and bags write the same bytes and read the same values."""

from dataclasses import fields, replace

import numpy as np
import pytest

from beetle_omni_ros.bags.bag import read_all
from beetle_omni_ros.bags.messages import Diagnostic, from_bytes, MessageError, to_bytes, Wrench
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.body import BodyState
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)

STAMP = 1_790_000_000.25
SERIES = ('mocap/pose', 'imu/data_raw', 'joint_states', 'battery_state', 'rotor_states', 'odom',
          'command', 'nmpc/command', 'ground_truth/odom', 'disturbance')


def value(topic, seed=0, stamp=STAMP):
    draw = np.random.default_rng(seed).normal
    turn = rotations.normalized(draw(size=4))
    path = TrajectoryTarget(stamp + np.arange(3.0), draw(size=(3, 3)), np.tile(turn, (3, 1)),
                            draw(size=(3, 3)), draw(size=(3, 3)), stamp)
    made = {
        PoseReading: lambda: PoseReading(stamp, draw(size=3), turn),
        ImuReading: lambda: ImuReading(stamp, draw(size=3), draw(size=3)),
        JointReading: lambda: JointReading(stamp, draw(size=4), draw(size=4), draw(size=4)),
        BatteryReading: lambda: BatteryReading(stamp, 24.5, -20.25),
        RotorReading: lambda: RotorReading(stamp, draw(size=4)),
        BodyState: lambda: BodyState(stamp, draw(size=3), draw(size=3), turn, draw(size=3)),
        PoseTarget: lambda: PoseTarget(draw(size=3), turn, stamp),
        TrajectoryTarget: lambda: path,
        Command: lambda: Command(stamp, draw(size=4), draw(size=4)),
        ActuatorHealth: lambda: ActuatorHealth(
            (True, False, True, True), (None, 0.5, None, None), thrust_limit=8.75),
        Wrench: lambda: Wrench(stamp, draw(size=3), draw(size=3)),
        str: lambda: 'waiting', Mode: lambda: Mode('flying:nmpc'),
        Diagnostic: lambda: [Diagnostic(stamp, 'ekf_node: inputs', 2, 'silent', {'a': '1'}),
                             Diagnostic(stamp, 'ekf_node: compute', 0, 'well')]}
    return made[ALL[topic].value]()


def cdr(topic, of):
    return bytes(to_bytes(ALL[topic].write(of), ALL[topic].type))


@pytest.mark.parametrize('topic', list(ALL))
def test_ros_reads_and_writes_the_same_bytes(topic):
    serialization = pytest.importorskip('rclpy.serialization')
    from beetle_omni_ros.ros import wire
    kept = cdr(topic, value(topic))
    sent = serialization.serialize_message(serialization.deserialize_message(
        kept, wire.message_class(ALL[topic].type)))
    assert 0 <= len(sent) - len(kept) <= 8
    # Between aligned fields and at the end a middleware leaves any bytes.
    assert bytes(to_bytes(from_bytes(sent, ALL[topic].type), ALL[topic].type)) == kept


@pytest.mark.parametrize('topic', list(ALL))
def test_a_value_comes_back_from_its_message(topic):
    entry, sent = ALL[topic], value(topic)
    for read in (entry.read, entry.take):
        back = read(from_bytes(cdr(topic, sent), entry.type))
        if isinstance(sent, (str, list)):
            assert back == sent
            continue
        assert isinstance(back, entry.value)
        for field in fields(back):
            mine, theirs = getattr(sent, field.name), getattr(back, field.name)
            if isinstance(theirs, (float, np.ndarray)):
                np.testing.assert_allclose(theirs, mine, rtol=1e-6, atol=1e-9)


def test_odometry_carries_the_twist_in_base_link():
    sent = value('odom')
    message = from_bytes(cdr('odom', sent), ALL['odom'].type)
    twist = message.twist.twist.linear
    assert np.allclose(rotations.matrix(sent.quaternion) @ [twist.x, twist.y, twist.z],
                       sent.velocity)


@pytest.mark.parametrize(('topic', 'written', 'bad', 'reason'), [
    ('rotor_states', 'joint_states', JointReading(1.0, np.zeros(1), None), 'names are not'),
    ('joint_states', 'joint_states', JointReading(1.0, np.zeros(1), None), 'too few'),
    ('target_pose', 'target_pose', PoseTarget(np.zeros(3), [0, 0, 0, 0.9]), 'unit quaternion')])
def test_a_bad_message_is_refused_with_a_reason(topic, written, bad, reason):
    with pytest.raises(MessageError, match=reason):
        ALL[topic].take(ALL[written].write(bad))


def test_unreadable_messages_are_counted_and_the_others_keep_their_order():
    sent = [value('joint_states', seed, STAMP + seed) for seed in range(12)]
    data = [cdr('joint_states', one) for one in sent]
    data.insert(5, data[0][:40])                # cut off
    data.insert(9, b'\0\1')                     # nothing
    data.insert(2, cdr('joint_states', JointReading(STAMP, np.ones(1), None, None, ['wheel'])))
    length = bytearray(cdr('joint_states', sent[0]))
    at = 4 + 8 + 4 + 4      # behind stamp and the empty frame_id: the number of names
    length[at:at + 4] = (0xFFFFFFF0).to_bytes(4, 'little')
    data.append(bytes(length))
    rows, values, refused = read_all(ALL['joint_states'], data)
    assert refused.total() == 4 and [data[row] for row in rows] == [
        cdr('joint_states', one) for one in values] == [cdr('joint_states', one) for one in sent]


@pytest.mark.parametrize('topic', [name for name in SERIES if name != 'rotor_states'])
def test_non_finite_values_are_read_but_refused_in_flight(topic):
    entry, sent = ALL[topic], value(topic)
    name = next(field.name for field in fields(sent)
                if field.name not in ('stamp', 'names'))
    part = getattr(sent, name)
    spoilt = replace(sent, **{name: part * np.nan if isinstance(part, np.ndarray) else np.nan})
    message = from_bytes(cdr(topic, spoilt), entry.type)
    assert np.isnan(getattr(entry.read(message), name)).all()
    with pytest.raises(MessageError, match='not finite'):
        entry.take(message)
