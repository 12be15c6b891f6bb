"""Outcome of every fault of the bus in the running loop."""

import time

import numpy as np
import pytest
from servo_bench import arrived, COUNT, read, running, tick, until

from beetle_omni_ros.drivers.servo_bus import RECOVERIES
from beetle_omni_ros.drivers.servo_xc330 import SILENT_AFTER

pytestmark = pytest.mark.real_time

GOAL = np.array([0.5, -1.0, 3.5, -3.5])
HOME = np.zeros(4)
BRISK = {'reply_time': 0.01}    # one fault costs one tick


def powered(readings, servos):
    return readings.valid.all() and all(
        one.torque and one.recovery is None and not one.message for one in servos)


@pytest.mark.parametrize('fault', ['bad_crc', 'dropped', 'delayed'])
def test_a_bad_line_costs_readings_but_never_gives_a_wrong_one(fault):
    with running(servos={'speed': 0.0}, **BRISK) as (bus, emulated):
        emulated.set_state(GOAL / 2, HOME, HOME)
        while not np.allclose(read(bus).position, GOAL / 2, atol=COUNT):
            pass
        setattr(emulated.faults, fault, 0.2)
        emulated.faults.delay = 0.012
        count = np.zeros(4)
        for _ in range(150):
            readings, _ = tick(bus, GOAL)
            assert readings.position == pytest.approx(GOAL / 2, abs=COUNT)
            count += readings.valid
        assert (count > 40).all()
        assert (count < 150).any(), 'the fault did show'
        assert bus.link.counts['unanswered'] + bus.link.counts['corrupt'] > 5
        assert bus.link.counts['connections'] == 1
        setattr(emulated.faults, fault, 0.0)
        until(lambda *now: powered(*now) and np.allclose(emulated.drive()[0], GOAL, atol=COUNT),
              bus, GOAL)


@pytest.mark.parametrize('silent', [{1}, {1, 2, 3, 4}])
def test_silent_servos_are_omitted_and_the_others_continue(silent):
    with running() as (bus, emulated):
        others = np.array([name not in silent for name in (1, 2, 3, 4)])
        emulated.faults.silent = set(silent)
        time.sleep(0.02)
        unheard = missing = 0
        for _ in range(20 + 10 * len(silent)):
            readings, servos = tick(bus, GOAL)
            unheard += not (readings.valid == others).all()
            missing += not readings.valid[others].all()
        assert (readings.valid == others).all()
        # The missing servo is last in the request, so the others lose one reading only.
        assert missing <= len(silent)
        assert unheard <= SILENT_AFTER * len(silent)
        for one, other in zip(servos, others, strict=True):
            assert ('silent; check its cable and power' in one.message) != other
        until(lambda readings, _: np.allclose(readings.position[others], GOAL[others],
                                              atol=2 * COUNT), bus, GOAL)
        emulated.faults.silent = set()
        until(lambda *now: arrived(GOAL)(*now) and powered(*now), bus, GOAL)
        lines = bus.take_events()
        assert sum('answers again' in line for line in lines) == len(silent)


def test_a_lasting_overload_disables_the_servo_with_a_reason_until_the_service_restarts_it():
    with running() as (bus, emulated):
        emulated.faults.overload = {2}
        _, servos = until(lambda _, servos: 'shut down (overload)' in servos[1].message
                          and servos[1].kept_off, bus, GOAL)
        assert 'reboot' in servos[1].message
        assert bus.servos[1].recoveries == RECOVERIES
        assert emulated.drive()[1] == [True, False, True, True]
        until(lambda readings, _: readings.valid.all(), bus, GOAL)
        emulated.faults.overload = set()
        for _ in range(50):
            tick(bus, GOAL)
        assert not emulated.drive()[1][1], 'nobody asked for it'
        emulated.faults.dropped = 1.0       # as an answer that is late on a busy computer
        bus.reboot(1)
        bus.upkeep()
        emulated.faults.dropped = 0.0
        until(lambda *now: powered(*now) and arrived(GOAL)(*now), bus, GOAL)


def test_expired_watchdogs_are_cleared_and_goals_are_followed_again():
    with running() as (bus, emulated):
        until(arrived(GOAL), bus, GOAL)
        emulated.servos[1].expire()
        assert emulated.servos[1].expired
        until(lambda *_: not emulated.servos[1].expired, bus, HOME)
        until(arrived(HOME), bus, HOME)
        assert any('stopped by its watchdog' in line for line in bus.take_events())
        time.sleep(0.15)        # a pause of the driver
        assert all(servo.expired for servo in emulated.servos)
        assert bus.write_goals(GOAL)
        bus.read()  # answered after the goals
        assert emulated.drive()[0] == pytest.approx(GOAL, abs=COUNT)
        assert not any(servo.expired for servo in emulated.servos)


def test_after_an_unplugged_cable_is_back_goals_are_followed_again():
    with running() as (bus, emulated):
        until(arrived(GOAL), bus, GOAL)
        for powered_off in (False, True):
            emulated.unplug()
            for _ in range(5):
                readings, servos = tick(bus, GOAL)
                assert not readings.valid.any()
                assert readings.position == pytest.approx(GOAL, abs=2 * COUNT), 'the last known'
            assert not bus.write_goals(GOAL) and not bus.link.is_open
            for index in range(4) if powered_off else ():
                emulated.reboot(index)      # they lose settings and turns
            emulated.plug()
            until(lambda *now: powered(*now) and arrived(GOAL)(*now), bus, GOAL)
        lines = bus.take_events()
        assert any('unplugged' in line for line in lines)
        assert any('connected again' in line for line in lines)
        assert bus.link.counts['connections'] == 3
        assert np.allclose([servo.angle for servo in emulated.servos], GOAL, atol=2 * COUNT)
        assert [servo['Bus Watchdog'] for servo in emulated.servos] == [5] * 4


def test_pending_torque_off_is_executed_when_cable_or_servo_are_back():
    with running() as (bus, emulated):
        emulated.unplug()
        assert not bus.disable()
        emulated.plug()
        until(lambda *_: not any(emulated.drive()[1]), bus, GOAL)
        bus.enable()
        emulated.faults.silent = {3}
        assert not bus.disable()
        assert any('torque off is not confirmed' in line and 'id 3' in line
                   for line in bus.take_events())
        emulated.faults.silent = set()
        assert emulated.drive()[1] == [False, False, True, False]
        until(lambda *_: not any(emulated.drive()[1]), bus, GOAL)
        assert any('still had torque' in line for line in bus.take_events())


def test_a_restart_in_flight_is_unwrapped_to_the_last_good_angle():
    with running() as (bus, emulated):
        goal = np.array([3.5, -3.5, 0.3, 0.0])
        until(arrived(goal), bus, goal)
        emulated.reboot(0)
        emulated.reboot(1)
        readings, _ = until(lambda *now: powered(*now) and all(emulated.drive()[1]),
                            bus, goal)
        assert readings.position == pytest.approx(goal, abs=0.1)
        assert emulated.servos[0]['Present Position'] < 4096, 'its own count is another'
        # And goals have the same meaning as before.
        further = np.array([3.9, -2.0, 0.3, 0.0])
        until(arrived(further), bus, further)
        assert np.allclose([servo.angle for servo in emulated.servos], further, atol=2 * COUNT)
        assert any('restarted' in line for line in bus.take_events())
