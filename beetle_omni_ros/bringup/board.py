"""Check of the motor board by its driver, which listens for some seconds and does not arm."""

from dataclasses import replace
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
from beetle_omni_ros.bringup.graph import ObservedGraph
from beetle_omni_ros.bringup.limits import BatteryLimits, CheckLimits, LinkLimits
from beetle_omni_ros.bringup.port import latency_finding, port_finding
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters
from beetle_omni_ros.robot.parameters import RobotParameters

BOARD, BRIDGE = 'motor board', 'rotor_bridge'
POLL_PERIOD = 0.02  # [s]
SETTLING = 0.3      # [s] until the board has received several of our packets


def check_board(parameters: MotorBoardParameters, robot: RobotParameters, limits: CheckLimits,
                seconds: float, graph: ObservedGraph | None = None) -> list[Finding]:
    """
    Check the motor board, listening for ``seconds``. A failure may end the list of findings.

    No rotor turns, and an armed board is disarmed at the end. ``graph`` is the observed ROS graph,
    used if a bridge has the port open.
    """
    port = port_finding('board port', parameters.port)
    if port.level != OK:
        return bridge_findings(port, BRIDGE, graph)
    try:
        from beetle_omni_ros.drivers.motor_board import MotorBoard
        from beetle_omni_ros.drivers.serial_port import SerialPortError
    except ModuleNotFoundError as error:
        return [port, missing_library(BOARD, error, 'hardware')]
    board = MotorBoard(parameters, robot)
    try:
        board.open()
    except SerialPortError as error:
        port = replace(port, level=FAIL, found=str(error), remedy='docs/how-to/hardware.md')
        return bridge_findings(port, BRIDGE, graph)
    try:
        battery, rotors, receptions = _listen(board, seconds)
        latency = latency_finding('board port latency timer', parameters.port,
                                  limits.link.latency_timer)
        status, link = board.state.status, board.link()
    finally:
        board.close()
    if status is None:
        return [port, latency, Finding(
            BOARD, FAIL, f"no heartbeat; {link['bytes']} bytes, {link['received']} good packets, "
            f"{link['foreign']} of other senders", _remedy_of_silence(link, parameters))]
    return [port, latency, *_of_status(status), _of_battery(battery, robot.battery.cells,
                                                            limits.battery),
            *_of_escs(rotors), _of_clock(link, parameters),
            *_of_link(link, receptions, limits.link)]


def _listen(board, seconds):
    """
    Poll the board.

    Returns:
        the newest battery and rotors, and a list of (number of packets sent, the board's counts)
        for each report of the board's reception.

    """
    rotors = battery = None
    receptions = []
    started = time.monotonic()
    while True:
        (new_battery, new_rotors, _), now = board.poll(), time.monotonic()
        rotors, battery = new_rotors or rotors, new_battery or battery
        reception = board.state.reception
        # The restart of our sequence numbers looks like lost packets to the board.
        if reception and now - started > SETTLING and \
                (not receptions or reception is not receptions[-1][1]):
            receptions.append((board.link()['sent'], reception))
        if now - started >= seconds:
            return battery, rotors, receptions
        time.sleep(POLL_PERIOD)


def _of_status(status):
    from beetle_omni_ros.drivers.motor_board_state import NO_HOST_HEARTBEAT
    blocking = [condition for condition in status.conditions if condition != NO_HOST_HEARTBEAT]
    receives = NO_HOST_HEARTBEAT not in status.conditions
    return [
        _of_firmware(status),
        Finding('board receives host', OK if receives else FAIL,
                'yes' if receives else NO_HOST_HEARTBEAT,
                '' if receives else "check the computer's TX wire, and host_system and "
                'host_component in params/motor_board.yaml'),
        Finding('board ready to arm', FAIL if blocking else OK, ', '.join(blocking) or 'yes',
                'charge the battery, check the ESCs, stop programs that command thrust'
                if blocking else '')]


def _remedy_of_silence(link, parameters):
    if link['foreign']:
        return (f'another device sends MAVLink; expected system '
                f'{parameters.board_system}, component {parameters.board_component}: '
                'params/motor_board.yaml')
    if link['bytes']:
        return f'wrong baud rate (here {parameters.baud} bit/s), or another firmware or device'
    return "check the board's power, the cable, TX and RX swapped, another port"


def _of_firmware(status):
    from beetle_omni_ros.drivers.motor_board_state import CONTRACT_VERSION
    values = {'contract': status.contract, 'state': status.state}
    if status.contract != CONTRACT_VERSION:
        return Finding('board firmware', FAIL, f'contract {status.contract}, this driver uses '
                       f'{CONTRACT_VERSION}', f'flash a firmware of contract {CONTRACT_VERSION}: '
                       'docs/reference/firmware.md', values)
    if status.armed:
        return Finding('board firmware', WARN, f'contract {status.contract}, {status.state}: '
                       'was armed by another program; disarmed now', 'find that program', values)
    stopped = '' if status.stop_reason == 'none' else f', last disarmed: {status.stop_reason}'
    return Finding('board firmware', OK, f'contract {status.contract}, {status.state}{stopped}',
                   values=values)


def _of_battery(battery, cells, limits: BatteryLimits):
    if battery is None:
        return Finding('battery', FAIL, 'no plausible voltage',
                       "check the board's voltage divider and its calibration")
    cell = battery.voltage / cells
    current = '' if np.isnan(battery.current) else f', {battery.current:.2f} A'
    found = f'{battery.voltage:.2f} V, {cell:.2f} V a cell of {cells}{current}'
    values = {'voltage_V': battery.voltage, 'cell_V': cell, 'current_A': battery.current}
    if cell > limits.cell_high:
        return Finding('battery', FAIL, found, 'calibrate the voltage, or correct battery.cells '
                       'in the robot file', values)
    level = FAIL if cell < limits.cell_fail_low else WARN if cell < limits.cell_low else OK
    return Finding('battery', level, found, '' if level == OK else 'charge it', values)


def _of_escs(rotors):
    if rotors is None:
        return [Finding('ESC telemetry', FAIL, 'no ESC_STATUS',
                        'the firmware must send it: docs/reference/firmware.md')]
    findings = []
    for k in range(4):
        online, faults = bool(np.isfinite(rotors.rpm[k])), ', '.join(rotors.failures[k])
        temperature = '' if np.isnan(rotors.temperature[k]) else f'{rotors.temperature[k]:.0f} C, '
        found = f"{temperature}{rotors.voltage[k]:.1f} V, {faults or 'no fault'}" \
            if online else 'offline'
        bad = faults or not online
        findings.append(Finding(
            f'ESC of rotor {k + 1}', FAIL if bad else OK, found, 'check its power, its signal and '
            'telemetry wires, and whether the rotor turns freely' if bad else '',
            {'temperature_C': rotors.temperature[k], 'voltage_V': rotors.voltage[k],
             'error_count': int(rotors.error_count[k])}))
    return findings


def _of_clock(link, parameters):
    offset, uncertainty = link['clock_offset_s'], link['clock_uncertainty_ms'] / 1e3
    values = {'offset_s': offset, 'uncertainty_s': uncertainty}
    if not np.isfinite(uncertainty):
        return Finding('board clock', FAIL, 'offset unknown: no answer to TIMESYNC',
                       "check the computer's TX wire; the firmware must answer TIMESYNC", values)
    return graded('board clock', f'offset {offset:.3f} s +- '
                  f'{1e3 * uncertainty:.2f} ms', uncertainty, 'slow answers to TIMESYNC: check '
                  'the latency timer of the adapter and the load of the computer', values=values,
                  warn=parameters.clock_uncertainty_limit / 2,
                  fail=parameters.clock_uncertainty_limit)


def _of_link(link, receptions, limits: LinkLimits):
    findings = [_of_direction('link from the board', link['lost'], link['bad_crc'],
                              link['received'], limits)]
    if len(receptions) < 2:
        return [*findings, Finding('link to the board', WARN, f'{len(receptions)} reports of the '
                                   "board's reception, two are needed",
                                   'increase the time: --seconds 4')]
    (before, first), (after, last) = receptions[0], receptions[-1]
    lost, bad_crc = (last[name] - first[name] for name in ('lost', 'bad_crc'))
    return [*findings, _of_direction('link to the board', lost, bad_crc,
                                     max(0, after - before - lost), limits)]


def _of_direction(item, lost, bad_crc, good, limits):
    # A corrupt packet also leaves a gap in the sequence numbers.
    bad = max(lost, bad_crc)
    return graded(item, f'{bad} of {good + bad} packets lost or corrupt', bad / max(1, good + bad),
                  'check cable, ground, distance to the motor wires, baud rate', warn=limits.loss,
                  fail=limits.loss_fail, values={'lost': lost, 'bad_crc': bad_crc, 'good': good})
