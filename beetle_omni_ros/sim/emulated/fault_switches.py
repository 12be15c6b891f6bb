"""Faults of the emulated devices as parameters: permanent levels, and single events."""

from dataclasses import dataclass, fields

import numpy as np

from beetle_omni_ros.robot.schema import parameter, ParameterError
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

SHARE = {'low': 0, 'high': 1}
LISTED = {'low': 1, 'high': 252}


@dataclass(frozen=True, kw_only=True)
class ServoFaultSwitches:
    """Faults of the servo bus."""

    bad_crc: float = parameter(0.0, doc='share of answers with a flipped bit', **SHARE)
    dropped: float = parameter(0.0, doc='share of lost answers', **SHARE)
    delayed: float = parameter(0.0, doc='share of late answers', **SHARE)
    delay: float = parameter(0.02, doc='delay of late answers', unit='s', low=0, high=10)
    silent: np.ndarray = parameter([], doc='IDs that receive and answer nothing', **LISTED)
    overload: np.ndarray = parameter([], doc='IDs with a permanent overload', **LISTED)
    overheated: np.ndarray = parameter([], doc='IDs above their temperature limit', **LISTED)
    supply_voltage: float = parameter(12.0, doc='supply voltage of the servos', unit='V', low=0,
                                      high=30)
    unplugged: bool = parameter(False, doc='whether the cable of the adapter is unplugged')
    reboot: int = parameter(0, doc='ID to restart once', low=0, high=252)
    expire_watchdog: int = parameter(0, doc='ID whose watchdog expires once', low=0, high=252)


@dataclass(frozen=True, kw_only=True)
class BoardFaultSwitches:
    """Faults of the motor board, its battery, its rotors and its cable."""

    corrupt_out: float = parameter(0.0, doc='share of packets of the board with a flipped bit',
                                   **SHARE)
    corrupt_in: float = parameter(0.0, doc='share of packets to the board with a flipped bit',
                                  **SHARE)
    drop_out: float = parameter(0.0, doc='share of lost packets of the board', **SHARE)
    drop_in: float = parameter(0.0, doc='share of lost packets to the board', **SHARE)
    delay_out: float = parameter(0.0, doc='delay of packets of the board', unit='s', low=0,
                                 high=10)
    delay_in: float = parameter(0.0, doc='delay of packets to the board', unit='s', low=0,
                                high=10)
    mute: bool = parameter(False, doc='whether all packets of the board are lost')
    voltage_sag: float = parameter(0.0, doc='drop of the battery voltage', unit='V', low=0,
                                   high=30)
    failed_escs: np.ndarray = parameter([], doc='rotors (1 to 4) that do not turn', low=1, high=4)
    unplugged: bool = parameter(False, doc='whether the cable of the board is unplugged')
    reboot: bool = parameter(False, doc='reset once')
    hang: bool = parameter(False, doc='hang once, until the reset by the watchdog')


SERVO_EVENTS, BOARD_EVENTS = ('reboot', 'expire_watchdog'), ('reboot', 'hang')
SERVO_LISTS = ('silent', 'overload', 'overheated')


def check_servo_faults(faults: ServoFaultSwitches, bus: EmulatedServoBus) -> None:
    """
    Check that the bus has the IDs.

    Raises:
        ParameterError: unknown ID; the message has key and IDs.

    """
    known = [servo['ID'] for servo in bus.servos]
    for name in SERVO_LISTS + SERVO_EVENTS:
        for wanted in np.ravel(getattr(faults, name)):
            if wanted not in known and not (name in SERVO_EVENTS and wanted == 0):
                raise ParameterError(f'servo_faults.{name}: no servo has the id {wanted:g}; '
                                     f'ids are {known}')


def check_board_faults(faults: BoardFaultSwitches) -> None:
    """
    Check the numbers of rotors.

    Raises:
        ParameterError: not a whole number; the message has key and value.

    """
    if np.any(faults.failed_escs != np.round(faults.failed_escs)):
        raise ParameterError('board_faults.failed_escs: expected rotors 1 to 4, found '
                             f'{faults.failed_escs}')


def set_servo_faults(faults: ServoFaultSwitches, bus: EmulatedServoBus) -> None:
    """Apply the levels and trigger the events."""
    for name in ('bad_crc', 'dropped', 'delayed', 'delay', 'supply_voltage'):
        setattr(bus.faults, name, getattr(faults, name))
    for name in SERVO_LISTS:
        setattr(bus.faults, name, set(_whole(getattr(faults, name))))
    (bus.unplug if faults.unplugged else bus.replug)()
    places = {servo['ID']: place for place, servo in enumerate(bus.servos)}
    if faults.reboot:
        bus.reboot(places[faults.reboot])
    if faults.expire_watchdog:
        bus.expire_watchdog(places[faults.expire_watchdog])


def set_board_faults(faults: BoardFaultSwitches, board: EmulatedMotorBoard) -> None:
    """Apply the levels and trigger the events."""
    for name in ('corrupt_out', 'corrupt_in', 'drop_out', 'drop_in', 'delay_out', 'delay_in',
                 'mute', 'voltage_sag'):
        setattr(board.faults, name, getattr(faults, name))
    board.faults.failed_escs = tuple(_whole(faults.failed_escs))
    (board.unplug if faults.unplugged else board.plug)()
    if faults.hang:
        board.hang()
    if faults.reboot:
        board.reboot()


def switched_on(faults: ServoFaultSwitches | BoardFaultSwitches) -> list[str]:
    """Levels that differ from their defaults, as texts such as 'silent [2]'."""
    healthy, found = type(faults)(), []
    events = SERVO_EVENTS if isinstance(faults, ServoFaultSwitches) else BOARD_EVENTS
    for entry in fields(faults):
        value = getattr(faults, entry.name)
        if entry.name in (*events, 'delay') or np.array_equal(value,
                                                              getattr(healthy, entry.name)):
            continue
        text = '' if value is True else f' {_whole(value)}' if isinstance(value, np.ndarray) \
            else f' {value:g}'
        found.append(entry.name + text)
    return found


def _whole(values):
    return sorted({int(value) for value in np.ravel(values)})
