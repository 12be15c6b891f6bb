"""Bring-up of the motor board: its own driver listens for some seconds; nothing is armed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import time

import numpy as np

from beetle_omni_ros.bringup.finding import (
    bridge_findings,
    FAIL,
    Finding,
    graded,
    missing_library,
    OK,
    WARN,
)
from beetle_omni_ros.bringup.heard import Heard
from beetle_omni_ros.bringup.limits import BatteryLimits, CheckLimits, LinkLimits
from beetle_omni_ros.bringup.port import latency_finding, port_finding, PROC, SYS
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.robot.parameters import RobotParameters

PORT, BOARD, BRIDGE = 'board port', 'motor board', 'rotor_bridge'
LOOK = 0.02     # [s] between two looks at what has come
SETTLING = 0.3  # [s] until the board has seen several of our packets


def check_board(parameters: MotorBoardParameters, robot: RobotParameters, limits: CheckLimits,
                seconds: float, heard: Heard | None = None, sys_root: Path = SYS,
                proc_root: Path = PROC) -> list[Finding]:
    """
    Look at the motor board; no rotor turns, an armed board is disarmed in the end.

    Args:
        parameters: of the link.
        robot: whose battery it is.
        limits: of what is well.
        seconds: to listen.
        heard: what ROS says, for the case that a bridge has the port; None: not listened.
        sys_root: of sysfs.
        proc_root: of procfs.

    Returns:
        findings; the list ends early where nothing behind the fault can be looked at.

    """
    port = port_finding(PORT, parameters.port, sys_root, proc_root)
    if port.level != OK:
        return bridge_findings(port, BRIDGE, heard)
    try:
        from beetle_omni_ros.drivers.motor_board import MotorBoard
        from beetle_omni_ros.drivers.serial_port import SerialPortError
    except ModuleNotFoundError as error:
        return [port, missing_library(BOARD, error, 'hardware')]
    board = MotorBoard(parameters, robot)
    try:
        board.open()
    except SerialPortError as error:
        taken = replace(port, level=FAIL, found=str(error), remedy='docs/how-to/hardware.md')
        return bridge_findings(taken, BRIDGE, heard)
    try:
        update, receptions = _listen(board, seconds)
        latency = latency_finding('board port latency timer', parameters.port,
                                  limits.link.latency_timer, sys_root)
    finally:
        board.close()
    return [port, latency, *_of_board(update, receptions, parameters, robot, limits)]


def _listen(board, seconds):
    """
    Listen.

    Returns:
        the last update, with the newest battery and rotors of all; and what the board has said
        of its reception: (packets sent until then, BoardReception), each time.

    """
    rotors = battery = None
    receptions = []
    started = time.monotonic()
    while True:
        update, now = board.poll(), time.monotonic()
        rotors, battery = update.rotors or rotors, update.battery or battery
        told = update.link.board
        # The first gap that the board sees is our start: its counts go back to its own.
        if told is not None and now - started > SETTLING and \
                (not receptions or told is not receptions[-1][1]):
            receptions.append((update.link.sent, told))
        if now - started >= seconds:
            return replace(update, rotors=rotors, battery=battery), receptions
        time.sleep(LOOK)


def _of_board(update, receptions, parameters, robot, limits):
    """Findings about a board whose port is open."""
    from beetle_omni_ros.drivers.motor_board_messages import UNHEARD
    status, received = update.status, update.link.received
    if status is None:
        return [Finding(BOARD, FAIL, f'no heartbeat; {received.bytes} bytes, '
                        f'{received.messages} good packets, {received.foreign} of others',
                        _why_mute(received, parameters))]
    blocking = [condition for condition in status.conditions if condition != UNHEARD]
    heard_us = UNHEARD not in status.conditions
    return [
        _of_firmware(status),
        Finding('board hears us', OK if heard_us else FAIL, 'yes' if heard_us else UNHEARD,
                '' if heard_us else "the computer's TX wire, or host_system and host_component "
                'in params/motor_board.yaml'),
        Finding('board ready to arm', FAIL if blocking else OK, ', '.join(blocking) or 'yes',
                'charge the battery, look at the ESCs, stop what asks for thrust'
                if blocking else ''),
        _of_battery(update.battery, robot.battery.cells, limits.battery),
        *_of_escs(update.rotors), _of_clock(update, parameters),
        *_of_link(update.link.received, receptions, limits.link)]


def _why_mute(received, parameters):
    if received.foreign:
        return (f'something else speaks MAVLink there; expected is system '
                f'{parameters.board_system}, component {parameters.board_component}: '
                'params/motor_board.yaml')
    if received.bytes:
        return f'wrong baud rate (here {parameters.baud} bit/s), or another firmware or device'
    return "the board's power, the cable, TX and RX swapped, another port"


def _of_firmware(status):
    from beetle_omni_ros.drivers.motor_board_messages import CONTRACT_VERSION
    values = {'contract': status.contract, 'state': status.state}
    if status.contract != CONTRACT_VERSION:
        return Finding('board firmware', FAIL, f'contract {status.contract}, this driver speaks '
                       f'{CONTRACT_VERSION}', f'flash a firmware of contract {CONTRACT_VERSION}: '
                       'docs/reference/firmware.md', values)
    if status.armed:
        return Finding('board firmware', WARN, f'contract {status.contract}, {status.state}: '
                       'somebody had armed it; disarmed now', 'find out who', values)
    stopped = '' if status.stop_reason == 'none' else f', last disarmed: {status.stop_reason}'
    return Finding('board firmware', OK, f'contract {status.contract}, {status.state}{stopped}',
                   values=values)


def _of_battery(battery, cells, limits: BatteryLimits):
    if battery is None:
        return Finding('battery', FAIL, 'no voltage that can be believed',
                       "the board's voltage divider and its calibration")
    cell = battery.voltage / cells
    current = '' if np.isnan(battery.current) else f', {battery.current:.2f} A'
    found = f'{battery.voltage:.2f} V, {cell:.2f} V a cell of {cells}{current}'
    values = {'voltage_V': battery.voltage, 'cell_V': cell, 'current_A': battery.current}
    if cell > limits.cell_high:
        return Finding('battery', FAIL, found, 'calibrate the voltage; another number of cells '
                       'than battery.cells of the robot file?', values)
    level = FAIL if cell < limits.cell_fail_low else WARN if cell < limits.cell_low else OK
    return Finding('battery', level, found, '' if level == OK else 'charge it', values)


def _of_escs(rotors):
    if rotors is None:
        return [Finding('ESC telemetry', FAIL, 'no ESC_STATUS',
                        'the firmware must send it: docs/reference/firmware.md')]
    findings = []
    for k in range(4):
        online, faults = bool(np.isfinite(rotors.rpm[k])), ', '.join(rotors.failures[k])
        hot = '' if np.isnan(rotors.temperature[k]) else f'{rotors.temperature[k]:.0f} C, '
        found = f"{hot}{rotors.voltage[k]:.1f} V, {faults or 'no fault'}" if online else 'offline'
        bad = faults or not online
        findings.append(Finding(
            f'ESC of rotor {k + 1}', FAIL if bad else OK, found, 'its power, its signal and '
            'telemetry wires, does the rotor turn freely?' if bad else '',
            {'temperature_C': rotors.temperature[k], 'voltage_V': rotors.voltage[k],
             'error_count': int(rotors.error_count[k])}))
    return findings


def _of_clock(update, parameters):
    uncertainty, values = update.clock_uncertainty, {
        'offset_s': update.clock_offset, 'uncertainty_s': update.clock_uncertainty}
    if not np.isfinite(uncertainty):
        return Finding('board clock', FAIL, 'offset unknown: no TIMESYNC was answered',
                       "the computer's TX wire; the firmware must answer it", values)
    return graded('board clock', f'offset {update.clock_offset:.3f} s, known to '
                  f'{1e3 * uncertainty:.2f} ms', uncertainty, 'TIMESYNC answered slowly: latency '
                  'timer of the adapter, load of the computer', values=values,
                  warn=parameters.clock_uncertainty_limit / 2,
                  fail=parameters.clock_uncertainty_limit)


def _of_link(received, receptions, limits: LinkLimits):
    findings = [_of_way('link from the board', received.lost, received.bad_crc,
                        received.messages, limits)]
    if len(receptions) < 2:
        return [*findings, Finding('link to the board', WARN, 'the board has told of its '
                                   f'reception {len(receptions)} times, twice are needed',
                                   'listen longer: --seconds 4')]
    (before, first), (after, last) = receptions[0], receptions[-1]
    lost, bad_crc = last.lost - first.lost, last.bad_crc - first.bad_crc
    return [*findings, _of_way('link to the board', lost, bad_crc,
                               max(0, after - before - lost), limits)]


def _of_way(item, lost, bad_crc, good, limits):
    # A spoilt packet is also missing in the sequence.
    bad = max(lost, bad_crc)
    return graded(item, f'{bad} of {good + bad} packets lost or spoilt', bad / max(1, good + bad),
                  'cable, ground, distance to the motor wires, baud rate', warn=limits.loss,
                  fail=limits.loss_fail, values={'lost': lost, 'bad_crc': bad_crc, 'good': good})
