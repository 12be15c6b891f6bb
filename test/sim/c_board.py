"""The firmware in C (folder firmware) in the place of the one of the emulated board."""

import ctypes
from ctypes import c_bool, c_size_t, c_uint32, c_uint64
from functools import cache
from pathlib import Path
import shutil
import subprocess
import tempfile

import pytest

pytest.importorskip('pymavlink')

from beetle_omni_ros.sim.emulated import motor_board
from beetle_omni_ros.sim.emulated.motor_board import BoardFirmware, NUMBERS

FOLDER = Path(__file__).resolve().parents[2] / 'firmware'
COMPILES = all(map(shutil.which, ('cc', 'gcov', 'make')))
NEEDS_COMPILER = pytest.mark.skipif(not COMPILES, reason='the C board needs cc, gcov, make')
REFUSALS = ('other addressee', 'other group', 'not finite', 'more than four rotors', 'stale stamp',
            'stamp in the future', 'older than the last', 'not armed')  # in the order of C
BUILD = tempfile.TemporaryDirectory(prefix='firmware_')
STOP = 1_000_000    # [ns]
SEND = ctypes.CFUNCTYPE(c_bool, ctypes.c_void_p, ctypes.c_void_p, c_size_t)


def make(*targets):
    """Make targets of firmware/Makefile in BUILD; return the output."""
    done = subprocess.run(['make', '-s', '-C', FOLDER, f'BUILD={BUILD.name}', *targets],
                          capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@cache
def library():
    make('all')
    return ctypes.CDLL(f'{BUILD.name}/libmotor_board.so')


class CFirmware:
    """The functions of firmware/motor_board.h with the methods of BoardFirmware."""

    def __init__(self, cells, now, **changes):
        self.numbers = (c_uint32 * (len(NUMBERS) + 1))(*(      # in the order of mb_numbers
            round(1000 * cells * value if name == 'arm_cell_voltage' else
                  1e6 / value if name.endswith('_rate') else 1e6 * value)
            for name, value in (NUMBERS | changes).items()), 1)
        self.voltage = self.current = 0.0
        self.rpm, self.failed, self._frames = [0.0] * 4, frozenset(), []
        self._send = SEND(lambda context, frame, size: self._frames.append(
            ctypes.string_at(frame, size)) is None)
        self.reboot(now, motor_board.CLOCK_START, False)

    def reboot(self, now, clock=0.0, by_watchdog=True):
        self._zero, self.next_due, self.timeouts, self.refused = now - clock, now, 0, {}
        self._board = ctypes.create_string_buffer(c_size_t.in_dll(library(), 'mb_size').value)
        library().mb_reset(self._board, self.numbers, self._send, None, by_watchdog,
                           self._now(now))

    def clock(self, now):
        return (now - self._zero) * (1 + motor_board.CLOCK_DRIFT)

    def _now(self, now):
        return c_uint64(round(1e6 * self.clock(now)))

    def serve(self, data, now):
        voltage, current = round(1000 * self.voltage), round(1000 * self.current)
        library().mb_battery(self._board, voltage, round(current / 10))
        for rotor in {0, 1, 2, 3} - self.failed:    # a failed ESC sends nothing
            library().mb_telemetry(self._board, rotor, (c_uint32 * 4)(
                round(self.rpm[rotor]), voltage, round(current / 4), 3500), self._now(now))
        library().mb_step(self._board, self._now(now))
        library().mb_receive(self._board, data, c_size_t(len(data)), self._now(now))
        _, _, self.timeouts, *refused = (c_uint32 * 11).from_buffer(self._board)
        self.refused = {reason: count for reason, count in zip(REFUSALS, refused) if count}
        self.next_due, frames, self._frames = now + 0.005, self._frames, []
        return frames

    def outputs(self, now):
        pulses = (c_uint32 * 4)()
        library().mb_pulses(self._board, self._now(now), pulses)
        return tuple((pulse - STOP) / STOP for pulse in pulses)

    def state(self, now):
        return library().mb_state(self._board, self._now(now))

    def conditions(self, now):
        return library().mb_conditions(self._board, self._now(now))


KINDS = [BoardFirmware, *[CFirmware] * COMPILES]
FIRMWARES = [BoardFirmware, pytest.param(CFirmware, marks=NEEDS_COMPILER)]
