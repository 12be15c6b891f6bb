"""rotor_bridge_node as a process with the emulated motor board; test/drivers has its faults."""

from contextlib import contextmanager
import os
import signal
import time

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from bridge_bench import QUICK, ROTOR, running_bridge, WITHIN

from beetle_omni_ros.drivers.mavlink import BOARD, HOST, MavlinkReceiver
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard, NUMBERS

pytestmark = pytest.mark.real_time
HOVER = np.array([7.0, 7.5, 8.0, 8.5])


class Bench:
    """One board, one bridge, one commanding node."""

    def __init__(self, board, graph, operator):
        self.board, self.graph, self.operator = board, graph, operator

    def take_off(self):
        self.operator.reaches('ready')
        self.operator.supervise('takeoff')
        self.operator.until(lambda: self.board.armed)
        self.follow(HOVER)

    def follow(self, thrust):
        """Command thrusts, and wait until the targets agree with them within 0.1 %."""
        self.operator.thrust = thrust
        self.operator.until(lambda: np.allclose(
            self.board.thrust_targets, thrust, rtol=1e-3, atol=0))

    def stops(self):
        self.operator.until(lambda: not self.board.armed and not self.board.commands.any())


@contextmanager
def bench(folder, **parameters):
    """Start a bridge; without a parameter ``port``, on an emulated board."""
    with EmulatedMotorBoard(**QUICK) as board, running_bridge(
            folder, ROTOR, **{'port': board.port, **parameters}) as (graph, operator):
        yield Bench(board, graph, operator)


def test_the_bridge_arms_at_takeoff_follows_thrusts_and_disarms_with_the_supervisor(tmp_path):
    with bench(tmp_path) as made:
        board, operator = made.board, made.operator
        operator.thrust = np.zeros(4)
        operator.reaches('ready')
        operator.spin(0.2)
        assert not board.armed and not board.firmware.refused  # not before it is armed
        made.take_off()
        for state, thrust in (('flying:nmpc', [3.0, 12.0, 0.5, 20.0]), ('landing', [9, 9, 1, 0])):
            operator.supervise(state)
            made.follow(thrust)
        repeats_commands_until_they_are_old(made)
        operator.bridge_states.clear()
        operator.supervise('disarmed')
        made.stops()
        operator.until(lambda: 'waiting: throttle not low' in operator.bridge_states
                       and operator.now == 'ready')
        assert not any(text.startswith('lost') for text in operator.bridge_states)
        assert not made.graph.dead()


def arrivals_at(board):
    """List of (arrival [s], stamp [us]) of the targets from now on."""
    receiver, serve, arrivals = MavlinkReceiver(*HOST), board.firmware.serve, []

    def listening(data, now):
        arrivals.extend((now, message.time_usec) for message in receiver.feed(data)
                        if message.get_type() == 'SET_ACTUATOR_CONTROL_TARGET')
        return serve(data, now)

    board.firmware.serve = listening
    return arrivals


def repeats_commands_until_they_are_old(flying):
    board, operator = flying.board, flying.operator
    operator.period = 0.06
    arrivals = arrivals_at(board)
    operator.until(lambda: len(arrivals) > 60)
    stamps = [stamp for _, stamp in arrivals]
    assert stamps == sorted(stamps) and len(stamps) > 3 * len(set(stamps))
    operator.thrust = None
    # 100 ms after the last new target, however often it was repeated.
    operator.until(lambda: not board.commands.any())
    stopped = time.monotonic()
    assert board.firmware.timeouts and stopped < arrivals[-1][0] + NUMBERS['target_timeout']
    flying.follow(HOVER)
    operator.age = 0.2
    operator.until(lambda: not board.commands.any())
    operator.counts('inputs', 'command rejected: stale stamp', above=5)
    operator.age = 0.0
    flying.follow(HOVER)


def test_after_a_killed_bridge_no_rotor_turns_and_a_new_one_does_not_arm(tmp_path):
    with bench(tmp_path) as made:
        board, operator = made.board, made.operator
        made.take_off()
        arrivals = arrivals_at(board)
        operator.until(lambda: arrivals)
        made.graph.kill(ROTOR)
        looked, turning = time.monotonic(), 0.0
        while board.commands.any():
            turning, looked = looked, time.monotonic()
            time.sleep(0.001)
        # They turned at `turning` or later, also on a busy computer.
        assert turning < arrivals[-1][0] + NUMBERS['target_timeout']
        made.stops()
        operator.supervise('flying:nmpc')
        made.graph.start_process(ROTOR)
        operator.reaches('lost: the supervisor was not disarmed before')
        assert not board.armed and not board.commands.any()


def test_without_autostart_it_arms_only_while_activated_and_disarms_at_its_end(tmp_path):
    port = tmp_path / 'motor_board'
    with bench(tmp_path, autostart='none', port=str(port)) as made:
        board, operator = made.board, made.operator
        operator.reaches('waiting: not configured')
        assert not operator.change('configure')
        operator.reaches(f'waiting: {port}: cannot be opened (no such port')
        os.symlink(board.port, port)
        assert operator.change('configure')
        operator.reaches('waiting: not activated')
        operator.until(lambda: operator.batteries)                  # received, but not armed
        operator.supervise('takeoff')
        operator.reaches('lost: not activated')
        operator.supervise('disarmed')
        assert not board.armed and operator.change('activate')
        made.take_off()
        assert operator.change('deactivate')                        # in flight
        made.stops()
        operator.reaches('lost: not activated')
        assert operator.change('activate')
        operator.spin(0.3)
        assert not board.armed                                      # not in this flight
        operator.thrust = None
        operator.supervise('disarmed')
        made.take_off()
        made.graph.processes[ROTOR].send_signal(signal.SIGTERM)
        operator.reaches('lost: the bridge has stopped')
        assert made.graph.processes[ROTOR].wait(WITHIN) == 0
        with board._lock:
            heartbeat, *_ = MavlinkReceiver(*BOARD).feed(b''.join(
                board.firmware.serve(b'', time.monotonic() + 0.25)))
        assert not board.armed
        assert heartbeat.custom_mode >> 8 & 0xFF == 1       # requested by the host
