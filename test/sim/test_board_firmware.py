"""The state machine of the emulated firmware against the protocol, without port or clock."""

from hypothesis import given, settings, strategies
import pytest

from beetle_omni_ros.sim.emulated import board_firmware as firmware
from beetle_omni_ros.sim.emulated import mavlink
from beetle_omni_ros.sim.emulated.board_firmware import BoardFirmware, EmulatedBoardParameters

PARAMETERS = EmulatedBoardParameters.load()
BOOTED = 100.0


class Bench:
    """A board and functions that send messages to it."""

    def __init__(self, voltage=25.0):
        self.now = BOOTED
        self.board = BoardFirmware(PARAMETERS, 6, BOOTED - PARAMETERS.boot_time)
        self.board.telemetry.voltage = voltage
        self.board.telemetry.current = 1.0

    def wait(self, seconds):
        self.now += seconds

    def send(self, number, *values, sender=(1, 191)):
        return self.board.receive(mavlink.Message(number, values, 0, *sender), self.now)

    def beat(self):
        self.send(mavlink.HEARTBEAT, 0, 18, 8, 0, 4, 3)

    def stamp(self, age=0.0):
        return round(1e6 * (self.board.clock(self.now) - age))

    def target(self, *commands, age=0.0, stamp=None, group=0, to=(1, 1)):
        stamp = self.stamp(age) if stamp is None else stamp
        controls = [*commands, *[0.0] * (8 - len(commands))]
        self.send(mavlink.ACTUATOR_TARGET, stamp, *controls, group, *to)

    def command(self, arm, force=0.0, number=400, to=(1, 1)):
        answers = self.send(mavlink.COMMAND_LONG, arm, force, 0, 0, 0, 0, 0, number, *to, 0)
        return answers[0][1][1:4:2] if answers else None     # result, result_param2

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
    bench.wait(1.1)
    bench.arm().target(0.1, 0.2, 0.3, 0.4)
    assert bench.outputs == (0.1, 0.2, 0.3, 0.4)
    assert bench.state == firmware.RUNNING


def test_arming_is_refused_without_heartbeat_with_the_reason():
    assert Bench().blocked_by() == firmware.NO_HEARTBEAT


def test_arming_is_refused_while_targets_are_above_zero():
    bench = Bench()
    bench.beat()
    bench.target(0.0, 0.01)
    bench.wait(0.9)
    assert bench.blocked_by() == firmware.THROTTLE
    bench.wait(0.2)
    bench.arm()


@pytest.mark.parametrize('voltage', [20.9, float('nan')])
def test_arming_is_refused_with_low_or_unknown_battery(voltage):
    bench = Bench(voltage)
    bench.beat()
    assert bench.blocked_by() == firmware.BATTERY_LOW


def test_arming_is_refused_with_a_failed_esc():
    bench = Bench()
    bench.beat()
    bench.board.telemetry.failed = frozenset([2])
    assert bench.blocked_by() == firmware.ESC_FAILURE


def test_force_overrides_nothing_and_other_commands_are_unsupported():
    bench = Bench()
    bench.beat()
    assert bench.command(1.0, force=21196.0) == (firmware.DENIED, 1)
    assert bench.command(0.5)[0] == firmware.DENIED
    assert bench.command(1.0, number=22)[0] == firmware.UNSUPPORTED
    assert bench.command(1.0, to=(1, 2)) is None
    assert bench.state == firmware.DISARMED


def test_disarming_is_always_accepted_also_with_force():
    bench = Bench().arm()
    bench.target(0.5)
    assert bench.command(0.0, force=21196.0) == (firmware.ACCEPTED, 0)
    assert bench.outputs == firmware.STOP
    assert bench.command(0.0) == (firmware.ACCEPTED, 0)


def test_arming_twice_is_accepted_in_flight():
    bench = Bench().arm()
    bench.target(0.5)
    assert bench.command(1.0) == (firmware.ACCEPTED, 1)
    assert bench.outputs[0] == 0.5


def test_rotors_stop_100_ms_after_the_last_target_and_start_again_with_the_next():
    bench = Bench().arm()
    bench.target(0.5)
    bench.wait(0.0999)
    assert bench.outputs[0] == 0.5
    bench.wait(0.0002)
    assert bench.outputs == firmware.STOP
    assert bench.state == firmware.ARMED
    assert bench.board.conditions(bench.now) & firmware.TIMED_OUT
    bench.target(0.4)
    assert bench.outputs[0] == 0.4


def test_repeating_an_old_target_does_not_keep_the_rotors_alive():
    bench = Bench().arm()
    stamp = bench.stamp()
    for _ in range(20):
        bench.target(0.5, stamp=stamp)
        assert bench.outputs[0] == 0.5
        bench.wait(0.0049)
    bench.wait(0.003)
    assert bench.outputs == firmware.STOP


@pytest.mark.parametrize('armed', [True, False])
def test_heartbeat_loss_disarms_despite_targets(armed):
    bench = Bench()
    if armed:
        bench.arm()
    for _ in range(220):
        bench.target(0.5)
        bench.wait(0.005)
    assert bench.outputs == firmware.STOP
    assert bench.state == firmware.DISARMED
    bench.beat()
    assert bench.outputs == firmware.STOP


def test_an_armed_board_without_targets_disarms():
    bench = Bench().arm()
    for _ in range(5):
        bench.wait(0.39)
        bench.beat()
        assert bench.state == firmware.ARMED
    bench.wait(0.1)
    assert bench.state == firmware.DISARMED


@pytest.mark.parametrize(('reason', 'make'), [
    ('stale stamp', lambda bench: bench.target(0.5, age=0.11)),
    ('stamp in the future', lambda bench: bench.target(0.5, age=-0.06)),
    ('older than the last', lambda bench: (bench.target(0.0), bench.target(0.5, age=0.001))),
    ('not finite', lambda bench: bench.target(float('nan'))),
    ('not finite', lambda bench: bench.target(0.1, float('inf'))),
    ('more than four rotors', lambda bench: bench.target(0.1, 0.1, 0.1, 0.1, 0.1)),
    ('other group', lambda bench: bench.target(0.5, group=1)),
    ('other addressee', lambda bench: bench.target(0.5, to=(1, 2)))])
def test_bad_targets_are_refused_and_counted(reason, make):
    bench = Bench().arm()
    make(bench)
    assert bench.outputs == firmware.STOP
    assert bench.board.refused == {reason: 1}


def test_commands_beyond_the_range_saturate():
    bench = Bench().arm()
    bench.target(1.5, -0.5, 0.5, 0.0)
    assert bench.outputs == (1.0, 0.0, 0.5, 0.0)
    assert bench.board.conditions(bench.now) & firmware.SATURATED


def test_commands_of_other_senders_are_ignored():
    bench = Bench()
    bench.send(mavlink.HEARTBEAT, 0, 6, 8, 0, 4, 3, sender=(255, 190))
    assert bench.blocked_by() == firmware.NO_HEARTBEAT
    bench.arm()
    bench.send(mavlink.ACTUATOR_TARGET, round(1e6 * bench.board.clock(bench.now)), *[0.5] * 4,
               *[0.0] * 4, 0, 1, 1, sender=(255, 190))
    assert bench.outputs == firmware.STOP


def test_during_a_hang_the_outputs_stay_until_the_watchdog_resets():
    bench = Bench().arm()
    bench.target(0.5)
    bench.board.hang(bench.now)
    bench.wait(0.09)
    bench.command(0.0)
    assert bench.outputs[0] == 0.5              # nothing executes
    bench.wait(0.011)
    assert bench.outputs == firmware.STOP
    assert bench.state == firmware.BOOT
    bench.wait(PARAMETERS.boot_time)
    (_, first), = bench.board.due(bench.now, mavlink.Parser())
    assert first[0] & 0xFF == firmware.BOOT
    assert first[0] >> 8 & 0xFF == firmware.WATCHDOG
    assert bench.state == firmware.DISARMED


def test_a_reboot_in_flight_stops_at_once_and_needs_arming_again():
    bench = Bench().arm()
    bench.target(0.5)
    bench.board.reboot(bench.now)
    assert bench.outputs == firmware.STOP
    bench.wait(1.0)
    bench.beat()
    bench.target(0.5)
    assert bench.outputs == firmware.STOP


def test_the_time_answer_repeats_the_request_and_adds_the_board_clock():
    bench = Bench()
    ((number, (tc1, ts1)),) = bench.send(mavlink.TIMESYNC, 0, 12345)
    assert (number, ts1) == (mavlink.TIMESYNC, 12345)
    assert tc1 == pytest.approx(1e9 * bench.board.clock(bench.now), abs=1e3)
    assert bench.send(mavlink.TIMESYNC, 7, 12345) == []         # an answer is not answered


def test_messages_come_at_their_rates():
    bench, counts = Bench(), {}
    for _ in range(10001):
        for number, _values in bench.board.due(bench.now, mavlink.Parser()):
            counts[number] = counts.get(number, 0) + 1
        bench.wait(0.001)
    expected = {mavlink.HEARTBEAT: 50, mavlink.BATTERY_STATUS: 500, mavlink.ESC_STATUS: 1000,
                mavlink.ESC_INFO: 20, mavlink.SYS_STATUS: 10}
    for number, count in expected.items():
        assert count <= counts[number] <= count + 3


ACTIONS = strategies.sampled_from(['beat', 'arm', 'disarm', 'thrust', 'zero', 'old', 'nan',
                                   'reboot', 'hang', 'esc', 'low'])


@settings(max_examples=300, deadline=None)
@given(strategies.lists(strategies.tuples(ACTIONS, strategies.sampled_from(
    [0.0, 0.004, 0.05, 0.099, 0.3, 1.2])), max_size=60))
def test_no_sequence_of_events_turns_rotors_without_arming_or_a_fresh_target(events):
    bench, last_thrust, disarmed, hung = Bench(), -1.0, True, None
    for action, pause in events:
        if action == 'beat':
            bench.beat()
        elif action in ('arm', 'disarm'):
            answer = bench.command(float(action == 'arm'))
            if answer and answer[0] == firmware.ACCEPTED:
                disarmed = action == 'disarm'
        elif action == 'reboot':
            bench.board.reboot(bench.now)
            disarmed, hung = True, None
        elif action == 'hang':
            bench.board.hang(bench.now)
            hung = bench.now if hung is None else hung
        elif action == 'esc':
            bench.board.telemetry.failed ^= {1}
        elif action == 'low':
            bench.board.telemetry.voltage = 44.0 - bench.board.telemetry.voltage
        else:
            bench.target({'thrust': 0.5, 'old': 0.5, 'zero': 0.0, 'nan': float('nan')}[action],
                         age=0.2 * (action == 'old'))
            last_thrust = bench.now if action == 'thrust' else last_thrust
        bench.wait(pause)
        if any(bench.outputs):
            assert not disarmed
            limit = PARAMETERS.target_timeout + (PARAMETERS.watchdog_time if hung else 0)
            assert bench.now - last_thrust < limit + 1e-9
        if hung is not None and bench.now - hung >= PARAMETERS.watchdog_time:
            disarmed, hung = True, None


PAYLOADS = strategies.sampled_from(sorted(mavlink.MESSAGES)).flatmap(
    lambda number: strategies.tuples(strategies.just(number), strategies.binary(
        min_size=mavlink.MESSAGES[number][1].size, max_size=mavlink.MESSAGES[number][1].size)))


@settings(max_examples=300, deadline=None)
@given(strategies.lists(PAYLOADS, max_size=10), strategies.booleans())
def test_valid_frames_with_arbitrary_content_are_tolerated(payloads, armed):
    """Outputs stay within their range, and every answer can be packed."""
    bench = Bench()
    if armed:
        bench.arm()
    for number, payload in payloads:
        answers = bench.send(number, *mavlink.MESSAGES[number][1].unpack(payload))
        for answer in [*answers, *bench.board.due(bench.now, mavlink.Parser())]:
            mavlink.pack(*answer, 0, 1, 1)
        assert all(0 <= output <= 1 for output in bench.outputs)
        bench.wait(0.01)
