"""Stamps of targets on the board's clock: rising, repeating, without steps of the host clock."""

import time

import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from board_bench import connected, HOVER

pytestmark = pytest.mark.real_time


def test_a_step_of_the_computers_clock_does_not_stop_the_rotors():
    """Stamps and clock step together; the age of a stamp gives the board's clock."""
    shift = [0.0]
    with connected() as (emulated, board):
        board._clock = lambda: time.time() + shift[0]
        assert board.arm().accepted
        for k in range(60):
            shift[0] = 3600.0 * (k > 20) - 7200.0 * (k > 40)
            assert board.send(HOVER, time.time() + shift[0]).sent
            time.sleep(0.005)
            assert k < 10 or emulated.commands.all()
        assert sum(emulated.refused.values()) <= 2


def test_stamps_stay_monotonic_when_the_offset_is_corrected():
    with connected() as (emulated, board):
        stamps = []
        emulated.on_target = lambda now, values: stamps.append(values[0])
        assert board.arm().accepted
        clock, begin = board._watch.clock, time.time()
        for k, correction in enumerate((0.0, -0.003, 0.002, -0.003)):
            low, high, at = clock._bounds
            clock._bounds = low + correction, high + correction, at
            board.send(HOVER, begin + 0.001 * k)
            board.send(HOVER, begin + 0.001 * k)
            time.sleep(0.003)
        time.sleep(0.03)
        assert len(stamps) == 8
        assert stamps[::2] == stamps[1::2]
        assert stamps == sorted(stamps) and len(set(stamps)) == 4
        assert emulated.refused == {}
