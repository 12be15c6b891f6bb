"""Bring-up of the motor board: what works, and what to do about what does not."""

from __future__ import annotations

from dataclasses import dataclass, replace
import time

import numpy as np

from beetle_omni_ros.drivers.motor_board import MotorBoard
from beetle_omni_ros.drivers.motor_board_messages import BoardUpdate, CONTRACT_VERSION, UNHEARD
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.robot.parameters import RobotParameters

LISTEN = 2.5            # [s] two SYS_STATUS
LOSS_LIMIT = 0.01       # share of packets


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: what, whether it is well, what was found, what to do if not."""

    name: str
    ok: bool
    found: str
    advice: str = ''


def check_motor_board(parameters: MotorBoardParameters | None = None,
                      robot: RobotParameters | None = None) -> list[Finding]:
    """
    Look at the motor board for some seconds; no rotor turns.

    Returns:
        findings; the list ends early where nothing behind the fault can be looked at.

    """
    board = MotorBoard(parameters, robot)
    try:
        board.open()
    except SerialPortError as error:
        return [Finding('motor board port', False, str(error), 'see docs/hardware.md')]
    rotors = battery = None
    try:
        end = time.monotonic() + LISTEN
        while time.monotonic() < end:
            time.sleep(0.05)
            update = board.poll()
            rotors, battery = update.rotors or rotors, update.battery or battery
    finally:
        board.close()
    update = replace(update, rotors=rotors, battery=battery)
    findings = [Finding('motor board port', True, board.parameters.port)]
    return findings + _of_board(update, board.parameters)


def _of_board(update: BoardUpdate, parameters: MotorBoardParameters) -> list[Finding]:
    """Findings about a board whose port is open."""
    status, received = update.status, update.link.received
    if status is None:
        found = f'{received.bytes} bytes, {received.messages} good packets, no heartbeat'
        return [Finding('motor board', False, found,
                        'nothing: power, cable, TX and RX swapped; bytes without packets: baud '
                        'rate, another firmware, other MAVLink ids')]
    blocking = [condition for condition in status.conditions if condition != UNHEARD]
    uncertainty = update.clock_uncertainty
    return [
        Finding('motor board firmware', status.contract == CONTRACT_VERSION,
                f'contract {status.contract}, {status.state}',
                f'flash a firmware of contract {CONTRACT_VERSION}, docs/firmware.md'),
        Finding('motor board hears us', UNHEARD not in status.conditions,
                'yes' if UNHEARD not in status.conditions else UNHEARD,
                "the computer's TX wire, or other MAVLink ids in params/motor_board.yaml"),
        Finding('motor board ready to arm', not blocking, ', '.join(blocking) or 'yes',
                'charge the battery, look at the ESCs, stop what asks for thrust'),
        _of_battery(update.battery), *_of_escs(update.rotors),
        Finding('motor board clock', uncertainty < parameters.clock_uncertainty_limit,
                f'offset {update.clock_offset:.3f} s, known to {1e3 * uncertainty:.2f} ms',
                'TIMESYNC unanswered or slow: USB latency timer, load of the computer'),
        *_of_link(update)]


def _of_battery(battery):
    found = 'no BATTERY_STATUS' if battery is None else \
        f'{battery.voltage:.2f} V, {battery.current:.2f} A'
    return Finding('battery', battery is not None, found, 'voltage divider and its calibration')


def _of_escs(rotors):
    if rotors is None:
        return [Finding('ESC telemetry', False, 'no ESC_STATUS', 'telemetry wires of the ESCs')]
    findings = []
    for k in range(4):
        online, faults = bool(np.isfinite(rotors.rpm[k])), ', '.join(rotors.failures[k])
        found = f"{rotors.temperature[k]:.0f} C, {faults or 'no fault'}" if online else 'offline'
        findings.append(Finding(f'ESC of rotor {k + 1}', online and not faults, found,
                                'its signal and telemetry wires, its power'))
    return findings


def _of_link(update):
    link = update.link
    ways = [('from', link.received.lost + link.received.bad_crc, link.received.messages)]
    if link.board is not None:
        ways.append(('to', link.board.lost + link.board.bad_crc, link.sent))
    return [Finding(f'link {way} the motor board', bad <= LOSS_LIMIT * max(1, good),
                    f'{bad} of {good} packets lost or spoilt',
                    'cable, ground, distance to the motor wires, baud rate')
            for way, bad, good in ways]
