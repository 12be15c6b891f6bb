"""An emulated motor board, its driver, and a loop that sends targets."""

from contextlib import closing, contextmanager
from dataclasses import replace
import threading
import time

import numpy as np

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.motor_board import MotorBoard
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard

QUICK = {'boot_time': 0.05, 'idle_timeout': 1.0, 'throttle_low_time': 0.3, 'reception_rate': 10.0}
ROBOT = RobotParameters.load()
HOVER = np.array([7.0, 7.5, 8.0, 8.5])


def driver(port):
    return MotorBoard(replace(MotorBoardParameters.load(), port=port), ROBOT)


@contextmanager
def opened(port):
    with closing(driver(port)) as board:
        board.open()
        yield board


def until(condition, timeout=3.0):
    """Wait for a condition; return whether it became true."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.002)
    return True


class Pilot:
    """Sends thrusts at 200 Hz in a thread, as a bridge does."""

    def __init__(self, board):
        self.board, self.thrust, self.results = board, HOVER, []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        due = time.monotonic()
        while not self._stop.is_set():
            self.results.append(self.board.send(self.thrust, time.time()))
            due += 0.005
            time.sleep(max(0.0, due - time.monotonic()))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@contextmanager
def connected():
    with EmulatedMotorBoard(**QUICK) as emulated, opened(emulated.port) as board:
        assert until(lambda: not board.ready), board.ready
        yield emulated, board


@contextmanager
def flying():
    """Emulated board, driver and pilot, rotors following."""
    with connected() as (emulated, board):
        result = board.start(True).wait()
        assert result.accepted, result.reason
        with Pilot(board) as pilot:
            assert until(lambda: emulated.commands.all() and pilot.results)
            yield emulated, board, pilot
