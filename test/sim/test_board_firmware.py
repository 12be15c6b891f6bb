"""The firmware in C against the protocol, without clock; its build with sanitizers."""

from pathlib import Path
import shutil
import subprocess
import tempfile

from hypothesis import example, given, settings, strategies
import pytest
import reference_packets as reference

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers.mavlink import BOARD, common, HOST, MavlinkReceiver
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.emulated import motor_board as firmware
from beetle_omni_ros.sim.emulated.motor_board import BoardFirmware, library, NUMBERS

BOOTED = 100.0
STOPPED = (0.0,) * 4
ACCEPTED, TEMPORARILY_REJECTED, DENIED = range(3)       # MAV_RESULT
THROTTLE, TIMED_OUT, SATURATED = 4, 32, 64              # conditions
FOLDER = Path(__file__).resolve().parents[2] / 'firmware'
NEEDS_COMPILER = pytest.mark.skipif(not all(map(shutil.which, ('cc', 'gcov', 'make'))),
                                    reason='needs cc, gcov, make')
BUILD = tempfile.TemporaryDirectory(prefix='firmware_')


def make(*targets):
    """Make targets of firmware/Makefile in BUILD; return the output."""
    done = subprocess.run(['make', '-s', '-C', FOLDER, f'BUILD={BUILD.name}', *targets],
                          capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


class Bench:
    """A board and functions that send messages to it as bytes."""

    def __init__(self, **changes):
        self.now = BOOTED
        self.board = BoardFirmware(6, BOOTED - NUMBERS['boot_time'], **changes)
        self.board.voltage, self.board.current = 25.0, 1.0
        self.board.rpm = [5000.0] * 4
        self.stamp, self.heard = 0, []
        self.packer, self._receiver = common.MAVLink(None, *HOST), MavlinkReceiver(*BOARD)

    def wait(self, seconds):
        self.now += seconds

    def feed(self, data=b''):
        """Messages of the board after these bytes, by name; the last one of each."""
        messages = [message for frame in self.board.serve(data, self.now)
                    for message in self._receiver.feed(frame)]
        self.heard += messages
        return {message.get_type(): message for message in messages}

    def send(self, message):
        frame = message.pack(self.packer)
        self.packer.seq = (self.packer.seq + 1) % 256
        return self.feed(frame)

    def beat(self):
        self.send(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))

    def target(self, *commands, age=0.0, stamp=None, group=0, to=(1, 1)):
        now = max(0, round(1e6 * (self.board.clock(self.now) - age)))
        self.stamp = now if stamp is None else stamp
        return self.send(common.MAVLink_set_actuator_control_target_message(
            self.stamp, group, *to, [*commands, *[0.0] * (8 - len(commands))]))

    def command(self, arm, force=0.0, number=400, to=(1, 1)):
        answer = self.send(common.MAVLink_command_long_message(
            *to, number, 0, arm, force, 0, 0, 0, 0, 0)).get('COMMAND_ACK')
        return answer and (answer.result, answer.result_param2)

    def arm(self):
        self.beat()
        assert self.command(1.0) == (ACCEPTED, 1)
        return self

    @property
    def outputs(self):
        return self.board.outputs(self.now)

    @property
    def conditions(self):
        return library().mb_conditions(self.board._board, self.board._micros(self.now))

    @property
    def state(self):
        return self.board.state(self.now)

    def blocked_by(self):
        result, detail = self.command(1.0)
        assert (result, detail & 1) == (TEMPORARILY_REJECTED, 1)
        assert self.state == firmware.DISARMED
        return detail >> 8


@pytest.fixture
def bench():
    return Bench()


def test_targets_are_ignored_until_armed_and_followed_then(bench):
    bench.beat()
    bench.target(0.5, 0.5, 0.5, 0.5)
    assert bench.outputs == STOPPED
    bench.wait(0.9)
    assert bench.blocked_by() == THROTTLE
    bench.wait(0.2)
    bench.arm().target(0.1, 0.2, 0.3, 0.4)
    assert bench.outputs == (0.1, 0.2, 0.3, 0.4) and bench.state == firmware.RUNNING
    assert bench.command(1.0) == (ACCEPTED, 1)     # again, in flight
    assert bench.command(1.0, force=21196.0) == (DENIED, 1)    # nothing is forced
    assert bench.command(1.0, to=(1, 2)) is None
    assert bench.outputs[0] == 0.1
    bench.target(1.5, -0.5, 0.5, 0.0)
    assert bench.outputs == (1.0, 0.0, 0.5, 0.0)
    assert bench.conditions & SATURATED


def test_rotors_stop_100_ms_after_the_last_target_and_start_again_with_the_next(bench):
    bench.arm().target(0.5)
    bench.wait(0.0999)
    assert bench.outputs[0] == 0.5
    bench.wait(0.0002)
    assert bench.outputs == STOPPED and bench.state == firmware.ARMED
    assert bench.conditions & TIMED_OUT
    bench.target(0.4)
    assert bench.outputs[0] == 0.4
    stamp = bench.stamp + 1000
    for _ in range(20):     # the first is new, the repetitions do not keep the rotors alive
        bench.target(0.5, stamp=stamp)
        assert bench.outputs[0] == 0.5
        bench.wait(0.0049)
    bench.wait(0.003)
    assert bench.outputs == STOPPED


@pytest.mark.parametrize(('reason', 'make'), [
    ('stale stamp', lambda bench: bench.target(0.5, age=0.11)),
    ('stamp in the future', lambda bench: bench.target(0.5, age=-0.06)),
    ('older than the last', lambda bench: (bench.target(0.0), bench.target(0.5, age=0.001))),
    ('not finite', lambda bench: bench.target(float('nan'))),
    ('more than four rotors', lambda bench: bench.target(0.1, 0.1, 0.1, 0.1, 0.1)),
    ('other group', lambda bench: bench.target(0.5, group=1)),
    ('other addressee', lambda bench: bench.target(0.5, to=(1, 2)))])
def test_bad_targets_are_refused_and_counted(bench, reason, make):
    make(bench.arm())
    assert bench.outputs == STOPPED
    assert bench.board.refused == {reason: 1}
    bench.wait(1.0)
    assert bench.feed()['SYS_STATUS'].errors_count3 == 1


def test_the_documented_frames_are_obeyed_also_after_noise_and_damaged_frames(bench):
    bench.board.reboot(bench.now)
    bench.wait(1.234567)
    assert [message.custom_mode for message in bench.feed().values()] == [0x01030400]     # boot
    signed, long = bytearray(reference.DISARM), bytearray(reference.DISARM)
    long[1] += 30           # must not hide the frames behind it
    signed[2] = 1           # with a valid checksum
    signed[-2:] = reference.crc(signed[1:-2] + bytes([152])).to_bytes(2, 'little')
    answers = bench.feed(b'noise\xfd' + reference.HOST_HEARTBEAT + reference.ARM + long
                         + reference.TARGET + signed + bytes(13) + reference.TIME_REQUEST
                         + bytes(300))      # longer than a frame
    assert answers['COMMAND_ACK'].result_param2 == 1
    assert answers['TIMESYNC'].ts1 == 0x0102030405060708
    assert answers['TIMESYNC'].tc1 == pytest.approx(1.234567e9, rel=1e-4)
    assert bench.outputs == (0.5, 0.25, 1.0, 0.0)


ACTIONS = {
    'beat': Bench.beat, 'arm': lambda b: b.command(1.0), 'disarm': lambda b: b.command(0.0),
    'force': lambda b: b.command(1.0, 1.0), 'other': lambda b: b.command(1.0, number=511),
    'time': lambda b: b.send(common.MAVLink_timesync_message(0, 7)),
    'answer': lambda b: b.send(common.MAVLink_timesync_message(1, 7)),
    'thrust': lambda b: b.target(0.5), 'zero': lambda b: b.target(0.0),
    'clipped': lambda b: b.target(1.5, -0.5, 0.25, 0.7), 'old': lambda b: b.target(0.5, age=0.2),
    'ahead': lambda b: b.target(0.5, age=-0.04), 'again': lambda b: b.target(0.6, stamp=b.stamp),
    'nan': lambda b: b.target(float('nan'), stamp=0), 'cut': lambda b: b.feed(reference.ARM[:-4]),
    'damaged': lambda b: b.feed(reference.ARM[:-1] + b'a'), 'noise': lambda b: b.feed(b'\xfe\xfd'),
    'lost': lambda b: setattr(b.packer, 'seq', b.packer.seq ^ 8),
    'reboot': lambda b: (b.board.reboot(b.now), setattr(b, 'stamp', 0)),
    'esc': lambda b: (setattr(b.board, 'failed', b.board.failed ^ {1}), b.wait(0.110007)),
    'low': lambda b: setattr(b.board, 'voltage', 44.0 - b.board.voltage)}


@settings(max_examples=300, deadline=None)
@given(events=strategies.lists(strategies.tuples(   # no sum of pauses is a limit of the contract
    strategies.sampled_from(list(ACTIONS)), strategies.sampled_from(
        [0.0, 0.004007, 0.030007, 0.050007, 0.099007, 0.300007, 1.200007])), max_size=60))
@example(events=[('ahead', 0.110007), ('again', 0.0)])     # too late for the rotors
def test_after_any_events_rotors_turn_only_if_armed_and_by_fresh_targets(events):
    bench, last_target, disarmed = Bench(idle_timeout=0.4), -1.0, True
    for action, pause in [('beat', 0.004007), ('arm', 0.0), *events]:
        answer = ACTIONS[action](bench)
        bench.wait(pause)
        bench.feed()
        if action == 'reboot' or action in ('arm', 'disarm') and answer and answer[0] == ACCEPTED:
            disarmed = action != 'arm'
        if action in ('thrust', 'zero', 'clipped', 'ahead'):
            last_target = bench.now - pause
        if any(bench.outputs):
            assert not disarmed and bench.state == firmware.RUNNING
            assert bench.now - last_target < NUMBERS['target_timeout'] + 1e-5


@pytest.mark.parametrize(('failed', 'rpm', 'after', 'flags'), [
    ({2}, 5000, 0.1, 64), (set(), 0, 0.2, 32)], ids=['silent', 'standing'])
def test_a_lost_esc_is_reported_in_time_and_stops_no_other_rotor(failed, rpm, after, flags):
    bench = Bench().arm()
    bench.board.failed, bench.board.rpm[2] = failed, rpm
    while bench.now < BOOTED + after - 1e-6:
        assert 'ESC_INFO' not in bench.target(0.5, 0.5, 0.5, 0.5)
        bench.wait(0.01)
    info = bench.feed()['ESC_INFO']
    assert (info.info, info.failure_flags[2], info.temperature[2]) == (0b1011, flags, 32767)
    assert bench.outputs == (0.5,) * 4


def test_its_numbers_are_those_of_the_contract_and_dshot_frames_have_a_checksum():
    numbers = BoardFirmware(6, BOOTED).numbers
    with pytest.raises(ParameterError, match="unknown number; did you mean 'boot_time'"):
        BoardFirmware(6, BOOTED, boot_tim=0.1)
    assert [*type(numbers).in_dll(library(), 'mb_contract')] == [*numbers]
    frames = [library().mb_dshot(1_000_000 + pulse, telemetry) & 0xFFFF for pulse, telemetry in (
        (499_250, False), (0, False), (0, True), (1_000_000, False), (1, False))]
    assert frames == [0x82C6, 0, 0x11, 0xFFEE, 0x606]   # the first: 1046, the usual example


@NEEDS_COMPILER
def test_random_events_execute_every_line_and_violate_no_property_under_sanitizers():
    assert 'Lines executed:100.00%' in make('coverage')
    assert make('fuzz', 'SECONDS=5')
