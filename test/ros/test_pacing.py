"""Ticks in real time after stalls, stamps that follow the clock, and simulated time."""

from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.ros.sim_node import (
    CATCH_UP_TICKS,
    PATIENCE,
    RealTimePacing,
    SimulatedTimePacing,
)

TICK, ROS = 0.005, 1.8e9


@pytest.fixture
def clock():
    return SimpleNamespace(now=ROS)


def run(pacing, clock, seconds, jitter=None):
    """Fire the timer once a tick; return the ages of the stamps at each call."""
    ages = []
    for k in range(round(seconds / TICK)):
        late = jitter[k] if jitter is not None else 0.0
        clock.now += late
        if pacing.due():
            ages.append(clock.now - pacing.epoch - pacing.ticks * TICK)
        clock.now += TICK - late
    return np.array(ages)


def test_jitter_loses_no_ticks(clock):
    pacing = RealTimePacing(TICK, lambda: clock.now)
    ages = run(pacing, clock, 10.0, np.random.default_rng(2).uniform(0, 0.003, 2000))
    assert pacing.ticks == pytest.approx(2000, abs=1) and pacing.lost_ticks == 0
    assert ages.max() < 0.0035 and ages.min() > -0.002


@pytest.mark.parametrize(('step', 'ticks'), [(3.0, 200 + CATCH_UP_TICKS), (-3600.0, 200)])
def test_a_stall_and_a_clock_that_was_set_cause_no_lasting_delay(clock, step, ticks):
    pacing = RealTimePacing(TICK, lambda: clock.now)
    run(pacing, clock, 0.5)
    clock.now += step
    assert pacing.due() == ticks - 200
    clock.now += TICK
    assert np.abs(run(pacing, clock, 0.5)).max() < 1e-4
    assert pacing.ticks == pytest.approx(ticks, abs=1)
    assert pacing.lost_ticks == pytest.approx(max(0, step / TICK - CATCH_UP_TICKS), abs=2)


@pytest.fixture
def waiting(clock):
    return SimulatedTimePacing(TICK, ROS, lambda: clock.now)


def fly(waiting, clock, seconds, answers):
    """Fire the timer; ``answers(k)`` is the stamp that is answered after call k, or None."""
    for k in range(round(seconds / TICK)):
        if waiting.due():
            waiting.sent = waiting.now
        clock.now += TICK
        if (stamp := answers(k)) is not None:
            waiting.answered('odom', stamp)


def test_simulated_time_continues_while_all_nodes_answer_or_none_has_yet(waiting, clock):
    fly(waiting, clock, 1.0, lambda k: None)
    fly(waiting, clock, 1.0, lambda k: waiting.now)
    assert waiting.ticks == 400
    assert waiting.now == pytest.approx(ROS + 2.0)


def test_simulated_time_waits_for_an_answer_as_long_as_its_interval_says_that_it_is_due(
        waiting, clock):
    fly(waiting, clock, 0.02, lambda k: ROS + 0.01 * (k // 2))      # an answer each 10 ms
    ticks = waiting.ticks
    fly(waiting, clock, 10 * TICK, lambda k: None)      # the next one is due and does not come
    assert waiting.ticks - ticks <= 2
    waiting.answered('odom', waiting.sent)
    assert waiting.due() == 1


def test_simulated_time_stands_still_at_a_pause(waiting, clock):
    waiting.pause_at = 0.1
    fly(waiting, clock, 1.0, lambda k: waiting.now)
    assert waiting.now == pytest.approx(ROS + 0.1)
    waiting.pause_at = 1e9
    assert waiting.due() == 1


def test_simulated_time_waits_once_for_each_silence_of_a_node(waiting, clock):
    fly(waiting, clock, 0.5, lambda k: waiting.now)
    fly(waiting, clock, 2.0, lambda k: None)
    waits = 500 - waiting.ticks
    assert 0 < waits <= PATIENCE / TICK + 1
    fly(waiting, clock, 0.1, lambda k: ROS + 0.5 if k == 0 else None)
    assert 520 - waiting.ticks - waits == pytest.approx(19, abs=1)
