"""The loop of the bus: goals without delay, one transaction at a time, constant rate."""

from threading import Lock, Thread
import time
from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.drivers.servo_loop import PERIOD, ServoLoop

FOREVER = float('inf')
VALID = np.ones(4, bool)


class FakeBus:
    """Stores goals; checks that only one thread uses it at a time."""

    def __init__(self):
        self.link = SimpleNamespace(path='/dev/none', is_open=True)
        self.servos = [SimpleNamespace(name=f'gimbal{k}', message='') for k in (1, 2, 3, 4)]
        self.obeying = self.valid = VALID
        self.enabled, self.closed = True, False
        self.goals, self.lines = [], []
        self.during_read = lambda: None
        self.log = self.lines.append
        self._busy = Lock()

    def upkeep(self):
        assert self._busy.acquire(blocking=False), 'two transactions at a time'
        time.sleep(0)
        self._busy.release()

    def write_goals(self, tilt):
        self.upkeep()
        self.goals.append(float(tilt[0]))
        return self.enabled

    def read(self):
        self.upkeep()
        self.during_read()
        return self.valid

    def reading(self, which):
        return which

    def close(self):
        self.closed = True


def make(**options):
    bus, clock, seen = FakeBus(), SimpleNamespace(now=100.0), []
    loop = ServoLoop(bus, seen.append, clock=lambda: clock.now, **options)
    return loop, bus, clock, seen


def goal(number, expires=FOREVER):
    return np.full(4, float(number)), float(number), expires


def wait_for(condition, limit=10.0):
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_only_the_newest_goals_given_during_a_transaction_are_written():
    loop, bus, _, _ = make()
    bus.during_read = lambda: (loop.offer(*goal(1)), loop.offer(*goal(2)),
                               bus.goals.append('read'))
    loop._lock.acquire()
    loop._cycle()
    loop._lock.release()
    assert bus.goals == ['read', 2]


def test_goals_are_repeated_until_they_are_too_old():
    loop, bus, clock, _ = make()
    loop.offer(*goal(1, expires=clock.now + 0.1))
    loop._cycle()
    assert bus.goals == [1], 'written since the last cycle'
    loop._cycle()
    assert bus.goals == [1, 1]
    clock.now += 0.2
    loop._cycle()
    assert bus.goals == [1, 1]
    loop.offer(*goal(2, expires=clock.now - 0.01))
    assert bus.goals == [1, 1] and loop.stale == 1


def test_readings_include_validity_and_obedience_of_each_servo():
    loop, bus, _, seen = make()
    bus.valid = np.array([True, True, False, True])
    bus.obeying = np.array([False, True, True, True])
    loop._cycle()
    bus.enabled = False     # then none obeys, and all angles count
    loop._cycle()
    assert seen[0].tolist() == [False, True, False, True]
    assert seen[1].tolist() == [True, True, False, True]
    assert loop.incomplete == 2 and loop.cycles == 2


@pytest.mark.real_time
def test_goals_of_many_threads_are_all_handled():
    bus = FakeBus()
    loop = ServoLoop(bus, lambda *_: None)
    loop.start()

    threads = [Thread(target=lambda: [loop.offer(*goal(k)) for k in range(200)]) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    loop.offer(*goal(-1))
    wait_for(lambda: bus.goals[-1:] == [-1])
    with loop.exclusive() as mine:
        count = loop.cycles
        assert mine is bus
        loop.offer(*goal(-2))
        assert bus.goals[-1] == -1, 'the bus is ours'
    wait_for(lambda: loop.cycles > count + 3)
    assert bus.goals[-1] == -2
    loop.stop()
    assert not loop._thread.is_alive() and not loop.failure and not bus.closed


def test_late_cycles_are_caught_up_and_missed_periods_counted_and_not_repeated():
    loop, _, clock, _ = make()
    for k in range(101):
        clock.now = 100.0 + k * PERIOD + (0.004 if k % 10 == 5 else 0.0)
        loop._cycle()
    assert loop.missed == 0 and loop._due == pytest.approx(100.0 + 101 * PERIOD)
    clock.now += 3.5 * PERIOD
    loop._cycle()
    assert loop.missed == 2
