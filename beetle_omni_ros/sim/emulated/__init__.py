"""Emulated devices on pseudo-terminals; here their faults as parameters."""

from dataclasses import dataclass, fields

import numpy as np

from beetle_omni_ros.robot.schema import parameter

SHARE = {'low': 0, 'high': 1}
LISTED = {'low': 1, 'high': 252}


@dataclass(kw_only=True)
class ServoFaults:
    """Faults of the servo bus. Levels may be changed at any time, events happen once."""

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


@dataclass(kw_only=True)
class BoardFaults:
    """Faults of motor board, battery, rotors and cable. Levels may be changed at any time."""

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


def switched_on(faults: ServoFaults | BoardFaults) -> list[str]:
    """Levels that differ from their defaults, as texts such as 'silent [2]'."""
    healthy, found = type(faults)(), []
    for name in (entry.name for entry in fields(faults)):
        value = getattr(faults, name)
        if name in (*SERVO_EVENTS, *BOARD_EVENTS, 'delay') \
                or np.array_equal(value, getattr(healthy, name)):
            continue
        if isinstance(value, np.ndarray):
            found.append(f'{name} {sorted({int(one) for one in value})}')
        else:
            found.append(name if value is True else f'{name} {value:g}')
    return found
