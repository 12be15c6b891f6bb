"""No sequence of inputs leads to an unsafe command."""

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
from vehicle_rig import flown, LEVEL, ROBOT, VehicleRig

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.model.mode import COMMAND_AGE

RUBBISH = [np.nan, np.inf, -np.inf, 1e300, -1e9, 0.0, 1.0, 3.9, -4.1, 25.0, -0.5]
numbers = st.one_of(st.sampled_from(RUBBISH), st.floats(-30, 30))
# Messages have a shape, and those of sensors a finite stamp.
fours = st.lists(numbers, min_size=4, max_size=4).map(np.array)
times = st.one_of(st.sampled_from([0.0, -0.02, -0.06, -5.0, 0.01, 0.5]), st.floats(-0.2, 0.1))
offsets = st.one_of(st.sampled_from([0.0, -0.02, -0.06, -5.0, 0.01, 0.5, np.nan, np.inf]),
                    st.floats(-0.2, 0.1))
actions = st.lists(st.one_of(
    st.tuples(st.just('wait'), st.sampled_from([0.01, 0.03, 0.2, 0.7, 3.0])),
    st.tuples(st.just('jump'), st.sampled_from([0.04, 1.0, -2.0])),
    st.tuples(st.just('command'), st.sampled_from(['nmpc', 'rl']), offsets, fours, fours),
    st.tuples(st.just('spoil'), st.sampled_from(RUBBISH), st.integers(0, 7)),
    st.tuples(st.just('state'), times, fours, fours, fours),
    st.tuples(st.just('raw'), times, fours, fours), st.tuples(st.just('battery'), numbers),
    st.tuples(st.just('bridge'), st.sampled_from(['joint', 'rotor']),
              st.sampled_from(['ready', 'waiting: port', 'lost: it', '', 'x'])),
    st.tuples(st.just('toggle'), st.sampled_from(
        ['estimate', 'joints', 'imu', 'mocap', 'nmpc', 'rl'])),
    st.tuples(st.just('ask'), st.sampled_from(
        ['arm', 'disarm', 'land', 'emergency_stop', 'nmpc', 'rl', 'x']))), max_size=12)


def perform(rig, action):
    """Apply one event to the supervisor."""
    supervisor, (kind, *rest) = rig.supervisor, action
    if kind == 'jump':
        # A delay: the clock advances before the waiting messages are read.
        rig.now += rest[0]
        supervisor.update(rig.now)
    elif kind == 'command':
        supervisor.inputs.on_command(rest[0], Command(rig.now + rest[1], rest[2], rest[3]),
                              rig.now)
    elif kind == 'spoil':
        # One wrong number in a new, otherwise good command.
        values = np.concatenate([np.zeros(4), np.full(4, ROBOT.hover_thrust)])
        values[rest[1]] = rest[0]
        supervisor.inputs.on_command(supervisor.active, Command(rig.now + 0.01, values[:4],
                                                         values[4:]), rig.now)
    elif kind == 'state':
        supervisor.inputs.on_state(State(
            rig.now + rest[0], rest[1][:3], rest[2][:3], LEVEL, rest[3][:3], rest[3], rest[2],
            rig.now + rest[0]))
    elif kind == 'raw':
        supervisor.inputs.on_imu(rig.now + rest[0], rest[1][:3], rest[2][:3])
        supervisor.inputs.on_mocap(rig.now + rest[0], rest[1][:3], rest[2])
        supervisor.inputs.on_joints(rig.now + rest[0], rest[1], rest[2])
    elif kind == 'battery':
        supervisor.inputs.on_battery(rest[0])
    elif kind == 'bridge':
        supervisor.inputs.bridges[rest[0]] = rest[1]
    elif kind == 'toggle':
        rig.alive ^= {rest[0]}
    elif rest[0] in ('nmpc', 'rl', 'x'):
        supervisor.select(rest[0])
    else:
        getattr(supervisor, rest[0])(rig.now)


def watch(rig, command):
    """Invariants of every sent command."""
    supervisor = rig.supervisor
    if command is None:
        return
    assert np.isfinite(command.tilt).all() and np.isfinite(command.thrust).all()
    assert command.tilt.shape == command.thrust.shape == (4,)
    assert np.abs(command.tilt).max() <= ROBOT.joints.position_limit
    assert command.thrust.min() >= 0 and command.thrust.max() <= ROBOT.rotors.thrust_max
    assert supervisor.inputs._now - command.stamp <= COMMAND_AGE + 1e-9
    if supervisor.state in ('disarmed', 'emergency_stop'):
        assert not command.thrust.any()


# Found once: a voltage whose square overflows.
@example(airborne=True, sequence=[('battery', 1e300)])
@settings(max_examples=40, deadline=None, derandomize=True)
@given(airborne=st.booleans(), sequence=actions)
def test_no_unsafe_command_is_sent(airborne, sequence):
    rig = flown() if airborne else VehicleRig()
    inner = rig.supervisor.update

    def watched(now):
        command = inner(now)
        watch(rig, command)
        return command

    rig.supervisor.update = watched
    for action in sequence:
        if action[0] == 'wait':
            rig.run(action[1])
        else:
            perform(rig, action)
            rig.run(0.02)
    assert rig.supervisor.diagnostics()['state'] == rig.supervisor.state
