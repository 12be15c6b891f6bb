"""Ticks in real time after stalls, and stamps that follow the clock."""

from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.nodes.sim_node import (
    CATCH_UP_TICKS,
    LAG,
    PATIENCE,
    RealTimePacing,
    SimulatedTimePacing,
)

TICK, ROS = 0.005, 1.8e9


@pytest.fixture
def clock():
    """Steady time and ROS time minus steady time, both set by the test."""
    return SimpleNamespace(now=1000.0, offset=ROS)


@pytest.fixture
def pacing(clock):
    return RealTimePacing(TICK, lambda: clock.now, lambda: clock.now + clock.offset)


def run(pacing, clock, seconds, jitter=None):
    """Fire the timer once a tick; return the ages of the stamps at each call."""
    ages = []
    for k in range(round(seconds / TICK)):
        late = jitter[k] if jitter is not None else 0.0
        clock.now += late
        if pacing.due():
            ages.append(clock.now + clock.offset - pacing.epoch - pacing.ticks * TICK)
        clock.now += TICK - late
    return np.array(ages)


def test_jitter_loses_no_ticks(pacing, clock):
    ages = run(pacing, clock, 10.0, np.random.default_rng(2).uniform(0, 0.003, 2000))
    assert pacing.ticks == pytest.approx(2000, abs=1) and pacing.lost_ticks == 0
    assert ages.max() < 0.0035 and ages.min() > -0.002


def test_a_stall_loses_ticks_without_lasting_delay(pacing, clock):
    run(pacing, clock, 0.5)
    clock.now += 3.0                        # all processes stalled
    assert pacing.due() == CATCH_UP_TICKS
    clock.now += TICK
    assert np.abs(run(pacing, clock, 0.5)).max() < 1e-4
    assert pacing.ticks == 200 + CATCH_UP_TICKS
    assert pacing.lost_ticks == pytest.approx(3.0 / TICK - CATCH_UP_TICKS, abs=2)


def test_stamps_follow_a_clock_that_was_set(pacing, clock):
    run(pacing, clock, 0.5)
    clock.offset += 60.0
    assert np.abs(run(pacing, clock, 0.5)).max() < 1e-4
    assert pacing.clock_steps == 1
    clock.offset -= 3600.0
    assert np.abs(run(pacing, clock, 0.5)).max() < 1e-4
    assert pacing.ticks == 300 and pacing.lost_ticks == 0


def test_a_preemption_between_the_clock_readings_changes_no_stamp(clock):
    hold = [0.0]

    def ros():
        clock.now += hold[0]
        return clock.now + ROS

    pacing = RealTimePacing(TICK, lambda: clock.now, ros)
    run(pacing, clock, 0.5)
    hold[0] = 0.02
    pacing.due()
    assert pacing.clock_steps == 0


@pytest.fixture
def waiting(clock):
    return SimulatedTimePacing(TICK, lambda: clock.now, ROS)


def fly(waiting, clock, seconds, answers):
    """Fire the timer; ``answers(k)`` is the stamp that is answered after call k, or None."""
    for k in range(round(seconds / TICK)):
        if waiting.due():
            waiting.sample_sent(waiting.now)
        clock.now += TICK
        if (stamp := answers(k)) is not None:
            waiting.answered('odom', stamp)


def test_simulated_time_continues_while_all_nodes_answer_or_none_has_yet(waiting, clock):
    fly(waiting, clock, 1.0, lambda k: None)
    fly(waiting, clock, 1.0, lambda k: waiting.now - 0.5 * LAG)
    assert waiting.ticks == 400 and waiting.waits == 0
    assert waiting.now == pytest.approx(ROS + 2.0)


def test_simulated_time_is_as_slow_as_the_slowest_node(waiting, clock):
    leads, slowness = [], 10

    def answer(k):
        # one sample in `slowness` periods, in their order
        stamp = ROS + TICK * (k // slowness)
        leads.append(waiting.now - stamp)
        return stamp

    fly(waiting, clock, 2.0, answer)
    assert waiting.ticks == pytest.approx(400 / slowness, abs=LAG / TICK + 2)
    assert max(leads) <= LAG + 2 * TICK and waiting.lost_ticks == 0


def test_simulated_time_waits_once_for_each_silence_of_a_node(waiting, clock):
    fly(waiting, clock, 0.5, lambda k: waiting.now)
    fly(waiting, clock, 2.0, lambda k: None)
    silent = PATIENCE / TICK
    assert 0 < waiting.waits <= silent + 1
    assert waiting.ticks == 500 - waiting.waits
    before = waiting.waits
    fly(waiting, clock, 0.1, lambda k: ROS + 0.5 if k == 0 else None)
    assert waiting.waits - before == pytest.approx(19, abs=1)
