"""The table of topics: nodes and bags write the same bytes and read the same values."""

from dataclasses import fields, replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.bags.bag import read_columns
from beetle_omni_ros.bags.log import channels_of
from beetle_omni_ros.bags.messages import (
    columns,
    Diagnostic,
    from_bytes,
    MessageError,
    to_bytes,
    Wrench,
)
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)
from beetle_omni_ros.model.rotations import BodyState

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
    ('rotor_states', 'joint_states', JointReading(1.0, np.zeros(1), None), 'not rotor1'),
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
    rows, found, refused = read_columns(ALL['joint_states'], data, {'position': 4})
    assert refused.total() == 4 and [data[row] for row in rows] == [
        cdr('joint_states', one) for one in sent]
    assert found['stamp'].tolist() == [one.stamp for one in sent]
    assert np.array_equal(found['position'], [one.position for one in sent])


@pytest.mark.parametrize('topic', SERIES)
@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 99), st.sampled_from(
    ('', 'world', 'w0rld', 'joints', 'cut', 'long', 'encoding', 'text')))))
def test_messages_of_equal_layout_are_read_together_as_one_by_one(topic, drawn):
    entry, channels, data = ALL[topic], channels_of(topic) or {'speed': 4}, []
    for seed, kind in drawn:
        message = entry.write(value(topic, seed, STAMP + seed))
        message.header.frame_id = kind
        if kind == 'joints' and hasattr(message, 'name'):
            message.name, part = message.name[::-1], ('velocity', 'effort')[seed % 2]
            setattr(message, part, np.zeros(0))
        sent = bytearray(to_bytes(message, entry.type))
        if kind == 'text':
            sent[15] = 255      # the text, or its length
        data.append(bytes({'cut': sent[:-9], 'long': sent + b'abc', 'encoding': b'\0\0' + sent[2:]}
                          .get(kind, sent)))
    alone, refused = [], 0
    for one in data:
        try:
            alone.append(entry.read(from_bytes(one, entry.type)))
        except Exception:
            refused += 1
        else:       # none is left to the slower way
            assert columns(np.frombuffer(one, np.uint8)[None], entry.type)[1].all()
    rows, found, refusals = read_columns(entry, data, channels)
    assert len(rows) == len(alone) and refusals.total() == refused
    for name, column in found.items():
        parts = [getattr(one, name) for one in alone]
        np.testing.assert_allclose(column, np.reshape([
            np.full(4, np.nan) if part is None else part for part in parts], column.shape),
            rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize('topic', [name for name in SERIES if name != 'rotor_states'])
def test_non_finite_values_are_read_but_refused_in_flight(topic):
    entry, sent = ALL[topic], value(topic)
    name = next(field.name for field in fields(sent) if field.name not in ('stamp', 'names'))
    part = getattr(sent, name)
    spoilt = replace(sent, **{name: part * np.nan if isinstance(part, np.ndarray) else np.nan})
    message = from_bytes(cdr(topic, spoilt), entry.type)
    assert np.isnan(getattr(entry.read(message), name)).all()
    with pytest.raises(MessageError, match='not finite'):
        entry.take(message)
