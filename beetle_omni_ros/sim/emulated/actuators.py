"""Emulated servo bus and motor board as the actuators of a simulated robot."""

from __future__ import annotations

from collections import deque
from math import ceil
from typing import Any, TYPE_CHECKING

import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.emulated.device import BoardFaults, ServoFaults, switched_on
from beetle_omni_ros.sim.fault_kinds import Drive
from beetle_omni_ros.sim.sensors import Frame
from beetle_omni_ros.sim.simulator import ROUNDING, Simulator

if TYPE_CHECKING:       # pymavlink is needed by an emulated board only
    from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
    from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus


class EmulatedActuators:
    """
    Couples the devices with the simulator, which follows their goals and sets their sensors.

    The devices run in real time, so :meth:`step` is called once in each tick of real time. Their
    outputs act after the command delay of the conditions. A command for the IMU sample of one
    tick, received before the next tick, then acts at the same time as without devices.
    """

    def __init__(self, simulator: Simulator, bus: EmulatedServoBus, board: EmulatedMotorBoard):
        self.bus, self.board = bus, board
        self._simulator = simulator
        tilt, thrust = simulator.command_delays
        self._tilts = _line(tilt, simulator.tick, lambda: (np.zeros(4), [False] * 4))
        self._thrusts = _line(thrust, simulator.tick, lambda: np.zeros(4))
        truth = simulator.truth
        bus.set_state(truth.tilt, truth.tilt_velocity, np.zeros(4))
        board.set_rotors(truth.thrust)
        board.set_battery(simulator.battery.voltage, simulator.battery.current)

    @classmethod
    def of(cls, simulator: Simulator, robot: RobotParameters, servos: Any, *, seed: int = 0,
           servo_port: str = '', board_port: str = '') -> EmulatedActuators:
        """
        Make and connect both devices.

        ``servos`` has ids, signs and zeros of the servos; a port '' is a temporary one.
        """
        from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard  # has pymavlink
        from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
        bus = EmulatedServoBus(
            servos.ids.astype(int).tolist(), port=servo_port or None,
            signs=servos.signs.astype(int).tolist(), zeros=servos.zeros.astype(int).tolist(),
            seed=seed)
        return cls(simulator, bus, EmulatedMotorBoard(robot, seed=seed, port=board_port or None))

    def close(self) -> None:
        """Stop both devices and remove their ports."""
        self.bus.close()
        self.board.close()

    def step(self) -> Frame:
        """Advance the simulator by one tick."""
        goals, powered = self.bus.drive()
        self._tilts.append((np.array(goals), powered))
        self._thrusts.append(self.board.thrust_targets)
        tilt, powered = self._tilts[0]
        frame = self._simulator.step(Drive(tilt, self._thrusts[0], powered))
        joints, battery = frame.joints, self._simulator.battery
        # The current of a servo without torque is zero.
        self.bus.set_state(joints.position, joints.velocity, joints.effort * powered)
        self.board.set_battery(battery.voltage, battery.current)
        self.board.set_rotors(frame.truth.thrust)
        return frame

    def set_faults(self, servo: ServoFaults, board: BoardFaults) -> None:
        """
        Switch faults on and off.

        A ParameterError reports an unknown servo, without any change.
        """
        ids = [one['ID'] for one in self.bus.servos]
        for wanted in (*servo.silent, *servo.overload):
            if wanted not in ids:
                raise ParameterError(f'servo_faults: no servo has the id {wanted:g}; the ids are '
                                     f'{ids}')
        self.bus.faults, self.board.faults = servo, board

    @property
    def faults(self) -> list[str]:
        """Active faults as texts such as 'servo silent [2]'."""
        return [f'{name} {text}' for name, device in (('servo', self.bus), ('board', self.board))
                for text in switched_on(device.faults)]

    def status(self) -> dict[str, object]:
        """States and refusals of the devices, for diagnostics."""
        bus, board = self.bus, self.board
        return {'servo_port': bus.port, 'board_port': board.port, 'armed': board.armed,
                'torque': bus.drive()[1], 'servo refused': bus.refusals,
                **{f'board refused: {reason}': count
                   for reason, count in board.firmware.refused.items()}}


def _line(delay, tick, make):
    """Queue whose first entry is older than its last by ``delay`` [s], rounded up to ticks."""
    length = 1 + max(0, ceil(delay / tick - ROUNDING))
    return deque((make() for _ in range(length)), maxlen=length)
