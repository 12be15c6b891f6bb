"""Offset of clocks: the bound is valid for any delays, and a restart is detected."""

import math

from hypothesis import given, strategies
import pytest

from beetle_omni_ros.drivers.clock_offset import ClockOffset

DELAYS = strategies.floats(1e-5, 0.2)


@given(strategies.floats(-1e4, 1e4), strategies.floats(-1e-4, 1e-4),
       strategies.lists(strategies.tuples(DELAYS, DELAYS), min_size=1, max_size=50))
def test_the_true_offset_is_within_the_bound(start, drift, delays):
    """With unequal delays of 10 us to 0.2 s, and drift within its bound."""
    clock, now = ClockOffset(1e-4), 100.0

    def truth(time):
        return start + drift * (time - 100.0)

    for there, back in delays:
        remote = now + there + truth(now + there)
        assert not clock.add(now, remote, now + there + back)
        now += there + back
        assert abs(clock.offset() - truth(now)) <= clock.uncertainty(now) + 1e-9
        now += 0.2
        assert abs(clock.offset() - truth(now)) <= clock.uncertainty(now) + 1e-9


def test_one_fast_answer_outweighs_many_slow_ones():
    clock = ClockOffset(1e-5)
    clock.add(0.0, 50.0005, 0.001)
    for k in range(1, 100):
        clock.add(k, 50 + k + 0.08, k + 0.1)
    assert clock.offset() == pytest.approx(50, abs=2e-3)
    assert clock.uncertainty(100) < 2e-3


def test_a_restarted_clock_is_detected_and_the_offset_replaced():
    clock = ClockOffset(1e-4)
    assert not clock.add(10.0, 500.001, 10.002)
    assert clock.add(11.0, 0.001, 11.002)
    assert clock.jumps == 1
    assert clock.offset() == pytest.approx(-11, abs=1e-6)


def test_the_offset_is_undefined_before_the_first_answer():
    clock = ClockOffset(1e-4)
    assert not clock.known
    assert math.isnan(clock.offset())
    assert clock.uncertainty(5) == math.inf
    assert not clock.add(2.0, 1.0, 1.9)     # an answer before its request is ignored
    assert not clock.known
