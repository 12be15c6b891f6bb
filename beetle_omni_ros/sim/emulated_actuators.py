"""Emulated servo bus and motor board as the actuators of a simulated robot."""

from __future__ import annotations

from collections import deque
from math import ceil

import numpy as np

from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.command_link import ROUNDING
from beetle_omni_ros.sim.emulated.fault_switches import (
    BoardFaultSwitches,
    SERVO_EVENTS,
    SERVO_LISTS,
    ServoFaultSwitches,
    switched_on,
)
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
from beetle_omni_ros.sim.readings import Drive, Frame
from beetle_omni_ros.sim.simulator import Simulator


class EmulatedActuators:
    """
    Couples the devices with the simulator, which follows their goals and sets their sensors.

    The devices run in real time, so :meth:`step` is called once in each tick of real time. Their
    outputs act after the command delay of the conditions. A command for the IMU sample of one
    tick, received before the next tick, then acts at the same time as without devices. The bus
    has four servos without motion model. :meth:`close` closes both devices.
    """

    def __init__(self, simulator: Simulator, bus: EmulatedServoBus, board: EmulatedMotorBoard):
        self.bus, self.board = bus, board
        self._simulator = simulator
        tilt, thrust = simulator.command_delays
        self._tilts = _line(tilt, simulator.tick, lambda: (np.zeros(4), [False] * 4))
        self._thrusts = _line(thrust, simulator.tick, lambda: np.zeros(4))
        self._held: dict[int, float] = {}
        self._servo_faults, self._board_faults = ServoFaultSwitches(), BoardFaultSwitches()
        truth = simulator.truth
        bus.set_state(truth.tilt, truth.tilt_velocity, np.zeros(4))
        board.set_rotors(truth.thrust)
        board.set_battery(simulator.battery.voltage, simulator.battery.current)

    def __enter__(self) -> EmulatedActuators:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Stop both devices and remove their ports."""
        self.bus.close()
        self.board.close()

    def step(self) -> Frame:
        """Advance the simulator by one tick."""
        goals, powered, stopped = self.bus.drive()
        if any(stopped) or self._held:
            self._hold(goals, stopped)
        self._tilts.append((np.array(goals), powered))
        self._thrusts.append(self.board.thrust_targets)
        tilt, powered = self._tilts[0]
        frame = self._simulator.step(Drive(tilt, powered, self._thrusts[0]))
        self._update_devices(frame, powered)
        return frame

    def _hold(self, goals, stopped):
        """
        Hold the true angle of servos that their watchdog has stopped.

        Their goal differs from it by the encoder error, and the delayed goals are old.
        """
        for joint, stop in enumerate(stopped):
            if not stop:
                self._held.pop(joint, None)
                continue
            if joint not in self._held:
                held = self._held[joint] = float(self._simulator.truth.tilt[joint])
                for tilt, _ in self._tilts:
                    tilt[joint] = held
            goals[joint] = self._held[joint]

    def _update_devices(self, frame, powered):
        """Set the sensors of the devices; the current of a servo without torque is zero."""
        joints, pack, battery = frame.joints, frame.battery, self._simulator.battery
        self.bus.set_state(joints.position, joints.velocity, joints.effort * powered)
        voltage, current = battery.voltage, battery.current
        self.board.set_battery(voltage, current,
                               (pack.voltage - voltage, -pack.current - current))
        self.board.set_rotors(frame.truth.thrust)

    def set_faults(self, servo: ServoFaultSwitches, board: BoardFaultSwitches) -> None:
        """
        Switch faults on and off, and trigger the events that are set.

        Raises:
            ParameterError: unknown servo or rotor, without any change, or a port whose path is in
                use when it is plugged in.

        """
        _check_faults(servo, board, [one['ID'] for one in self.bus.servos])
        try:
            self._set_servo_faults(servo)
            self._set_board_faults(board)
        except OSError as error:
            raise ParameterError(str(error)) from None
        self._servo_faults, self._board_faults = servo, board

    def _set_servo_faults(self, faults):
        bus = self.bus
        bus.faults = faults
        (bus.unplug if faults.unplugged else bus.replug)()
        places = {servo['ID']: place for place, servo in enumerate(bus.servos)}
        if faults.reboot:
            bus.reboot(places[faults.reboot])
        if faults.expire_watchdog:
            bus.expire_watchdog(places[faults.expire_watchdog])

    def _set_board_faults(self, faults):
        board = self.board
        board.faults = faults
        (board.unplug if faults.unplugged else board.plug)()
        if faults.hang:
            board.hang()
        if faults.reboot:
            board.reboot()

    @property
    def faults(self) -> list[str]:
        """Active faults as texts such as 'servo silent [2]'."""
        return [f'{device} {text}' for device, faults in
                (('servo', self._servo_faults), ('board', self._board_faults))
                for text in switched_on(faults)]

    def status(self) -> dict[str, object]:
        """States and refusals of the devices, for diagnostics."""
        bus, board = self.bus, self.board
        return {'servo_port': bus.port, 'board_port': board.port, 'armed': board.armed,
                'torque': [bool(on) for on in bus.torque_enabled],
                'stopped': [bool(on) for on in bus.stopped],
                'servo refused': bus.network.refusals,
                **{f'board refused: {reason}': count for reason, count in board.refused.items()}}


def _check_faults(servo, board, known):
    """Refuse unknown IDs, and numbers of rotors that are not whole."""
    for name in SERVO_LISTS + SERVO_EVENTS:
        for wanted in np.ravel(getattr(servo, name)):
            if wanted not in known and not (name in SERVO_EVENTS and wanted == 0):
                raise ParameterError(f'servo_faults.{name}: no servo has the id {wanted:g}; '
                                     f'ids are {known}')
    if np.any(board.failed_escs != np.round(board.failed_escs)):
        raise ParameterError('board_faults.failed_escs: expected rotors 1 to 4, found '
                             f'{board.failed_escs}')


def _line(delay, tick, make):
    """Queue whose first entry is older than its last by ``delay`` [s], rounded up to ticks."""
    length = 1 + max(0, ceil(delay / tick - ROUNDING))
    return deque((make() for _ in range(length)), maxlen=length)
