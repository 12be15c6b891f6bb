"""The outcome of a flight from the truth, with one word for each kind of end."""

from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.flight.fault_flights import PLAN, Watcher
from beetle_omni_ros.sim.sensors import Impact, Truth

TICK = 0.005


def truth(t, height=1.0, x=0.0, contact=False, impact=None, broken=False):
    return Truth(t, np.array([x, 0.0, height]), np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3),
                 np.zeros(4), np.zeros(4), np.zeros(4), contact, impact, broken)


@pytest.fixture
def watch():
    return Watcher(SimpleNamespace(
        simulator=SimpleNamespace(truth=truth(0.0, 0.0), time=0.0), refusals=[], events=[],
        supervisor=SimpleNamespace(faults={}, state='disarmed')), PLAN)


def soft(t=1.0, speed=0.3, inclination=0.05):
    return Impact(t, speed, inclination)


def judged(watch, asked=True, state='disarmed', refusals=()):
    watch._loop.supervisor.state, watch._loop.refusals = state, refusals
    return watch.outcome(asked)


def test_a_soft_landing_counts_as_flies_on_lands_or_refused(watch):
    watch.step(truth(1.0, 0.15, contact=True, impact=soft()), 0.0, TICK)
    assert judged(watch) == 'flies_on'
    assert judged(watch, asked=False) == 'lands'
    assert judged(watch, refusals=['far']) == 'refused'
    assert judged(watch, state='flying') == 'does not land'


def test_a_hard_or_tilted_touchdown_is_not_a_landing(watch):
    watch.step(truth(1.0, impact=soft(inclination=1.1 * PLAN.inclination)), 0.0, TICK)
    assert judged(watch) == 'tilted'
    watch.step(truth(2.0, impact=soft(2.0, speed=1.1 * PLAN.impact_speed)), 0.0, TICK)
    assert judged(watch) == 'hard'


@pytest.mark.parametrize(('late', 'outcome'), [(0.2, 'stops'), (0.5, 'crash, motors on')])
def test_motors_must_stop_soon_after_a_crash(watch, late, outcome):
    for k in range(300):
        t = k * TICK
        watch.step(truth(t, 0.1, contact=True, impact=soft(0.1, 3.0), broken=t >= 0.1),
                   20.0 if t <= 0.1 + late else 0.0, TICK)
    assert judged(watch) == outcome
    assert np.isclose(watch.overrun, late, atol=2 * TICK)
    assert judged(watch, state='flying') == 'crash, motors on'


def test_a_flyaway_is_a_position_far_outside(watch):
    fence = watch._fence[0] + PLAN.fence_margin
    watch.step(truth(1.0, x=fence - 0.1), 20.0, TICK)
    assert judged(watch) != 'flyaway'
    watch.step(truth(1.0, x=fence + 0.1), 20.0, TICK)
    assert judged(watch) == 'flyaway'


def test_rising_after_rest_is_a_takeoff_and_bouncing_is_not(watch):
    for k in range(200):
        watch.step(truth(k * TICK, 0.15, contact=k % 40 > 0), 0.0, TICK)
    watch.step(truth(1.1, 1.0), 20.0, TICK)
    assert watch.takeoffs == 0
    for k in range(200):
        watch.step(truth(2 + k * TICK, 0.15, contact=True), 0.0, TICK)
    for height in (0.3, 0.7, 1.0):
        watch.step(truth(4.0, height), 20.0, TICK)
    assert watch.takeoffs == 1
    assert judged(watch) == 'takes off'
