"""Outcome of every fault of the motor board in flight."""

import time

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from board_bench import flying, HOVER, QUICK, until

pytestmark = pytest.mark.real_time


def keeps_flying(emulated, seconds=0.6):
    return not until(lambda: not emulated.commands.all(), seconds) and emulated.armed


def stays_stopped(emulated):
    return not until(emulated.commands.any, 0.5)


def arms_again(board, pilot):
    pilot.thrust = np.zeros(4)
    time.sleep(QUICK['throttle_low_time'])
    return until(lambda: board.start(True).wait().accepted)


@pytest.mark.parametrize('faults', [
    {'corrupt_out': 0.3}, {'corrupt_in': 0.3},
    {'drop_in': 0.3, 'drop_out': 0.3}], ids=str)
def test_a_poor_link_is_counted_and_tolerated(faults):
    with flying() as (emulated, board, _):
        for name, value in faults.items():
            setattr(emulated.faults, name, value)
        assert keeps_flying(emulated)
        assert board.state.status.armed

        def counted():
            link = board.link()
            return (link['bad_crc'] > 10) == ('corrupt_out' in faults) \
                and (link['lost'] > 10) == bool({'corrupt_out', 'drop_out'} & set(faults)) \
                and (link['board bad_crc'] > 10) == ('corrupt_in' in faults) \
                and (link['board lost'] > 10) == bool({'corrupt_in', 'drop_in'} & set(faults))

        assert until(counted)


def test_voltage_sag_is_compensated_or_reported_as_saturation():
    with flying() as (emulated, board, pilot):
        emulated.set_battery(25.0, 30.0)
        time.sleep(0.3)
        before = emulated.commands
        emulated.set_battery(22.0, 30.0)
        assert until(lambda: np.allclose(emulated.thrust_targets, HOVER, rtol=2e-3))
        assert np.all(emulated.commands > before)
        pilot.thrust = np.full(4, 20.0)
        assert until(lambda: board.saturated.all())
        emulated.set_battery(3.0, 0.0)
        assert until(lambda: board.state.implausible)
        assert keeps_flying(emulated, 0.2)


def test_a_long_disconnection_disarms_and_reconnecting_does_not_arm():
    with flying() as (emulated, board, pilot):
        emulated.unplug()
        assert until(lambda: not emulated.armed)
        emulated.plug()
        assert until(lambda: board.connected)
        assert stays_stopped(emulated)
        assert until(lambda: board.state.status.stop_reason == 'heartbeat of the host lost')
        assert arms_again(board, pilot)


def test_a_board_that_restarts_in_flight_stops_and_needs_arming_again():
    with flying() as (emulated, board, pilot):
        emulated.reboot()
        assert not emulated.commands.any()
        assert until(lambda: board.state.status.stop_reason == 'watchdog reset')
        assert stays_stopped(emulated) and not board.state.status.armed
        assert board.link()['lost'] == 0
        assert arms_again(board, pilot)
        pilot.thrust = HOVER
        assert until(lambda: emulated.commands.all())
