"""The driver against the emulated board over a pseudo-terminal."""

import os
import pty
import threading
import time

import numpy as np
import pytest
import reference_packets as reference

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from board_bench import connected, driver, flying, HOVER, opened, QUICK, until

from beetle_omni_ros.drivers import mavlink

pytestmark = pytest.mark.real_time


def test_refused_arming_is_reported_with_the_reason(monkeypatch):
    with connected() as (emulated, board):
        emulated.set_battery(20.0, 0.0)
        assert until(lambda: 'battery low' in board.state.status.conditions)
        assert board.start(True).wait().reason == 'refused by the board: battery low'
        emulated.set_battery(25.0, 0.0)
        assert board.start(True).wait().accepted and emulated.armed
        monkeypatch.setattr(mavlink, 'CONTRACT_VERSION', 9)
        assert board.start(True).wait().reason == 'firmware follows contract 1, this driver 9'


def test_an_independent_parser_accepts_all_output_of_the_driver():
    """Sequence numbers without gaps, the right sender, all messages of the protocol."""
    device, other = pty.openpty()
    received = bytearray()
    board = driver(os.ttyname(other))
    board.open()
    threading.Thread(target=lambda: board.start(False).wait(), daemon=True).start()
    board.state.clock.add(time.monotonic(), 1.0, time.monotonic())
    for _ in range(100):
        board.send(HOVER, time.time())
        time.sleep(0.005)
        received += os.read(device, 4096)
    closing = threading.Thread(target=board.close)
    closing.start()
    os.set_blocking(device, False)
    while closing.is_alive():
        try:
            received += os.read(device, 4096)
        except BlockingIOError:
            time.sleep(0.005)
    messages = [reference.parse(frame) for frame in reference.split(bytes(received))]
    assert {number for number, *_ in messages} == {0, 76, 111, 139}
    assert all(sender == (1, 191) for _, _, sender, _ in messages)
    assert [sequence for _, sequence, _, _ in messages] == [k % 256 for k in range(len(messages))]
    stamps = [values[0] for number, _, _, values in messages if number == 139]
    assert len(stamps) == 100 and np.all(np.diff(stamps) > 0)
    contents = [(number, values) for number, _, _, values in messages]
    for frame in (reference.HOST_HEARTBEAT, reference.DISARM):
        number, _, _, values = reference.parse(frame)
        assert (number, values) in contents
    os.close(device)
    os.close(other)


def test_without_a_board_every_call_times_out_soon_with_a_message():
    device, other = pty.openpty()
    with opened(os.ttyname(other)) as board:
        assert board.start(True).wait().reason == 'no message from the board'
        assert board.start(False).wait().reason == 'no acknowledgement to 5 attempts'
        assert board.send(HOVER, time.time()) == "offset of the board's clock unknown"
    os.close(device)
    os.close(other)


def test_a_step_of_the_computers_clock_does_not_stop_the_rotors():
    """Stamps and clock step together; the age of a stamp gives the board's clock."""
    shift = [0.0]
    with connected() as (emulated, board):
        board._clock = lambda: time.time() + shift[0]
        assert board.start(True).wait().accepted
        for k in range(60):
            shift[0] = 3600.0 * (k > 20) - 7200.0 * (k > 40)
            assert not board.send(HOVER, time.time() + shift[0])
            time.sleep(0.005)
            assert k < 10 or emulated.commands.all()
        assert sum(emulated.firmware.refused.values()) <= 2


# --- faults in flight ---------------------------------------------------------------------------

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
