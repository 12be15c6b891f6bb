"""The state machine of the emulated firmware against the protocol, without port or clock."""

from hypothesis import given, settings, strategies
import pytest

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers.mavlink import common
from beetle_omni_ros.sim.emulated import motor_board as firmware
from beetle_omni_ros.sim.emulated.motor_board import BoardFirmware, NUMBERS

BOOTED = 100.0


class Bench:
    """A board and functions that send messages to it."""

    def __init__(self, voltage=25.0):
        self.now = BOOTED
        self.board = BoardFirmware(6, BOOTED - NUMBERS['boot_time'])
        self.board.voltage, self.board.current = voltage, 1.0

    def wait(self, seconds):
        self.now += seconds

    def beat(self):
        self.board.receive(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), self.now)

    def stamp(self, age=0.0):
        return round(1e6 * (self.board.clock(self.now) - age))

    def target(self, *commands, age=0.0, stamp=None, group=0, to=(1, 1)):
        stamp = self.stamp(age) if stamp is None else stamp
        self.board.receive(common.MAVLink_set_actuator_control_target_message(
            stamp, group, *to, [*commands, *[0.0] * (8 - len(commands))]), self.now)

    def command(self, arm, force=0.0, number=400, to=(1, 1)):
        answers = self.board.receive(common.MAVLink_command_long_message(
            *to, number, 0, arm, force, 0, 0, 0, 0, 0), self.now)
        return (answers[0].result, answers[0].result_param2) if answers else None

    def arm(self):
        self.beat()
        assert self.command(1.0) == (firmware.ACCEPTED, 1)
        return self

    @property
    def outputs(self):
        return self.board.outputs(self.now)

    @property
    def state(self):
        return self.board.state(self.now)

    def blocked_by(self):
        result, detail = self.command(1.0)
        assert (result, detail & 1) == (firmware.TEMPORARILY_REJECTED, 1)
        assert self.state == firmware.DISARMED
        return detail >> 8


def test_targets_are_ignored_until_armed_and_followed_then():
    bench = Bench()
    bench.beat()
    bench.target(0.5, 0.5, 0.5, 0.5)
    assert bench.outputs == firmware.STOP
    bench.wait(0.9)
    assert bench.blocked_by() == firmware.THROTTLE
    bench.wait(0.2)
    bench.arm().target(0.1, 0.2, 0.3, 0.4)
    assert bench.outputs == (0.1, 0.2, 0.3, 0.4) and bench.state == firmware.RUNNING
    assert bench.command(1.0) == (firmware.ACCEPTED, 1)     # again, in flight
    assert bench.command(1.0, force=21196.0) == (firmware.DENIED, 1)    # nothing is forced
    assert bench.command(1.0, to=(1, 2)) is None
    assert bench.outputs[0] == 0.1
    bench.target(1.5, -0.5, 0.5, 0.0)
    assert bench.outputs == (1.0, 0.0, 0.5, 0.0)
    assert bench.board.conditions(bench.now) & firmware.SATURATED


def test_rotors_stop_100_ms_after_the_last_target_and_start_again_with_the_next():
    bench = Bench().arm()
    bench.target(0.5)
    bench.wait(0.0999)
    assert bench.outputs[0] == 0.5
    bench.wait(0.0002)
    assert bench.outputs == firmware.STOP and bench.state == firmware.ARMED
    assert bench.board.conditions(bench.now) & firmware.TIMED_OUT
    bench.target(0.4)
    assert bench.outputs[0] == 0.4
    stamp = bench.stamp()
    for _ in range(20):     # the first is new, the repetitions do not keep the rotors alive
        bench.target(0.5, stamp=stamp)
        assert bench.outputs[0] == 0.5
        bench.wait(0.0049)
    bench.wait(0.003)
    assert bench.outputs == firmware.STOP


@pytest.mark.parametrize(('reason', 'make'), [
    ('stale stamp', lambda bench: bench.target(0.5, age=0.11)),
    ('stamp in the future', lambda bench: bench.target(0.5, age=-0.06)),
    ('older than the last', lambda bench: (bench.target(0.0), bench.target(0.5, age=0.001))),
    ('not finite', lambda bench: bench.target(float('nan'))),
    ('more than four rotors', lambda bench: bench.target(0.1, 0.1, 0.1, 0.1, 0.1)),
    ('other group', lambda bench: bench.target(0.5, group=1)),
    ('other addressee', lambda bench: bench.target(0.5, to=(1, 2)))])
def test_bad_targets_are_refused_and_counted(reason, make):
    bench = Bench().arm()
    make(bench)
    assert bench.outputs == firmware.STOP
    assert bench.board.refused == {reason: 1}


ACTIONS = strategies.sampled_from(['beat', 'arm', 'disarm', 'thrust', 'zero', 'old', 'nan',
                                   'reboot', 'esc', 'low'])


@settings(max_examples=300, deadline=None)
@given(strategies.lists(strategies.tuples(ACTIONS, strategies.sampled_from(
    [0.0, 0.004, 0.05, 0.099, 0.3, 1.2])), max_size=60))
def test_no_sequence_of_events_turns_rotors_without_arming_or_a_fresh_target(events):
    bench, last_thrust, disarmed = Bench(), -1.0, True
    for action, pause in events:
        if action == 'beat':
            bench.beat()
        elif action in ('arm', 'disarm'):
            answer = bench.command(float(action == 'arm'))
            if answer and answer[0] == firmware.ACCEPTED:
                disarmed = action == 'disarm'
        elif action == 'reboot':
            bench.board.reboot(bench.now)
            disarmed = True
        elif action == 'esc':
            bench.board.failed ^= {1}
        elif action == 'low':
            bench.board.voltage = 44.0 - bench.board.voltage
        else:
            bench.target({'thrust': 0.5, 'old': 0.5, 'zero': 0.0, 'nan': float('nan')}[action],
                         age=0.2 * (action == 'old'))
            last_thrust = bench.now if action == 'thrust' else last_thrust
        bench.wait(pause)
        if any(bench.outputs):
            assert not disarmed
            assert bench.now - last_thrust < NUMBERS['target_timeout'] + 1e-9
