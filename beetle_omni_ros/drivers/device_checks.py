"""
Checks of ports, servos and motor board for `beetle_omni check`.

Servos get pings and reads only: nothing moves and no setting changes. The motor board is listened
to by its driver; no rotor turns, and an armed board is disarmed at the end.
"""

from math import inf
import os
from pathlib import Path
import time

import numpy as np

from beetle_omni_ros.drivers import servo_xc330 as xc330
from beetle_omni_ros.drivers.check import Findings, ObservedGraph
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.mavlink import CONTRACT_VERSION, NO_HOST_HEARTBEAT
from beetle_omni_ros.drivers.motor_board import MotorBoard
from beetle_omni_ros.drivers.serial_port import SerialPortError, usb_ports
from beetle_omni_ros.drivers.servo_link import ServoLink
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import JointParameters

SYS = Path('/sys')
GUIDE = 'docs/how-to/hardware.md'
BUS, BOARD = 'servo bus', 'motor board'
ROUNDS = 50             # reads of each servo to measure answer time and loss
POLL_PERIOD = 0.02      # [s] between polls of the board
SETTLING = 0.3          # [s] until the board has received several of our packets
LATENCY_TIMER = 1       # [ms] of FTDI adapters, docs/how-to/hardware.md
LOSS, LOSS_FAIL = (0, 0.01), (0, 0.1)       # [-] lost answers or packets; at 0.1 the joints jerk
# [V] supply of a servo: the smallest of the XC330-T181-T by its manual, to 5 % above the largest;
# half a volt below the recommended 11.1 V, it is weaker and slower.
SUPPLY, SUPPLY_FAIL = (10.5, 12.6), (6.5, 12.6)
CLOCK, CLOCK_FAIL = (0, 0.01), (0, 0.02)    # [s] error bound of the board's clock offset
TEMPERATURE = (-inf, 55.0)  # [C] at rest a servo has nearly room temperature; it stops at 70
# [V] cell at rest: about half empty; smallest for arming (supervisor.yaml). Above a full LiPo
# cell, 4.2 V, the calibration or the number of cells is wrong.
CELL, CELL_FAIL = (3.7, 4.25), (3.5, 4.25)


# --- ports --------------------------------------------------------------------------------------

def open_port(findings, device, name, path, bridge, graph):
    """
    Open ``device`` on its port ``path``; return whether it is open.

    Adds the port and the latency timer of a USB adapter, or why it is closed. A port that a
    running bridge has open is judged by the topics of this bridge in ``graph``.
    """
    item = f'{name} port'
    try:
        device.open()
    except SerialPortError as error:
        if graph and graph.runs(bridge) and 'another process' in str(error):
            findings.add(item, f'{error}; not opened, see what {bridge}_node reports')
        else:
            ports = '; '.join(f'{device}: {product}' for device, product in usb_ports().items())
            findings.add(item, str(error), fail=f'{GUIDE}; present USB ports: {ports or "none"}')
        return False
    real = os.path.realpath(path)
    names = [path if real == path else f'{path} ({real})', usb_ports().get(real)]
    findings.add(item, ', '.join(filter(None, names)))
    file = SYS / 'bus' / 'usb-serial' / 'devices' / Path(real).name / 'latency_timer'
    if file.is_file() and (text := file.read_text().strip()):
        findings.grade(f'{item} latency timer', f'{text} ms', float(text),
                       f'each answer waits for it: echo {LATENCY_TIMER} | sudo tee {file}; '
                       f'permanently: the udev rule of {GUIDE}', fail=(0, LATENCY_TIMER),
                       latency_timer_ms=int(text))
    return True


# --- servos -------------------------------------------------------------------------------------

def check_servos(parameters: ServoBusParameters, joints: JointParameters,
                 graph: ObservedGraph | None = None) -> Findings:
    """
    Check the bus and its servos. A failure may end the list of findings.

    ``graph`` is the observed ROS graph, used if a bridge has the port open.
    """
    findings = Findings()
    link = ServoLink(parameters.port, parameters.baud_rate, parameters.reply_time)
    if open_port(findings, link, 'servo', parameters.port, 'joint_bridge', graph):
        try:
            _check_bus(findings, link, parameters, joints)
        except SerialPortError as error:
            findings.add(BUS, str(error), fail=f'check cable and adapter: {GUIDE}')
        finally:
            link.close()
    return findings


def _check_bus(findings, link, parameters, joints):
    servos = xc330.make_servos(parameters)
    examined = [(servo, xc330.examine(link, servo)) for servo in servos]
    present = [servo for servo, (model, *_) in examined if model is not None]
    for servo in present:
        try:
            servo.torque = bool(link.read(servo.identifier, xc330.TORQUE_ENABLE, xc330.ATTEMPTS))
        except xc330.ServoBusError:
            servo.torque = None
    if not present:
        findings.add(BUS, f'no servo answers at {link.baud_rate} bit/s', fail="check the servos' "
                     'supply (their LEDs blink once at power-up), the data cable, and with '
                     'DYNAMIXEL Wizard their baud rates')
        return
    _check_answers(findings, link, present)
    for servo, (model, firmware, problem, remedy) in examined:
        if model is None:
            findings.add(servo.name, f'id {servo.identifier} {problem}',
                         fail='check its connector, and those before it in the chain; search '
                         'for its id and baud rate with DYNAMIXEL Wizard', id=servo.identifier)
            continue
        facts, values = f'id {servo.identifier}', {}
        if firmware is not None:
            facts += f', model {model}, firmware {firmware}, {servo.voltage:.1f} V, ' \
                f'{servo.temperature:.0f} C, {servo.position:+.2f} rad'
            values = {'supply_V': servo.voltage, 'temperature_C': servo.temperature,
                      'position_rad': servo.position}
        findings.add(servo.name, f'{problem}; {facts}' if problem else facts,
                     fail=remedy if problem else '', id=servo.identifier, model=model,
                     firmware=firmware, baud_rate=link.baud_rate, **values)
        if values:
            _check_servo(findings, servo, joints)


def _check_servo(findings, servo, joints):
    """Add a finding for each problem of supply, temperature, torque and turn."""
    name, volts, angle = servo.name, servo.voltage, servo.position
    limit = xc330.unambiguous_limit(joints.position_limit)
    doubts = xc330.settle([servo], joints.position_limit)       # the driver's rule
    rows = Findings()
    rows.grade(f'{name} supply', f'{volts:.1f} V, allowed are {SUPPLY_FAIL[0]:g} to '
               f'{SUPPLY_FAIL[1]:g} V, below {SUPPLY[0]:g} V it is slower and weaker than '
               'identified', volts, 'set the regulator to 11.1 to 12 V; check the drop over thin '
               'cables', warn=SUPPLY, fail=SUPPLY_FAIL, supply_V=volts)
    rows.grade(f'{name} temperature', f'{servo.temperature:.0f} C', servo.temperature,
               'let it cool; check what blocks the joint', warn=TEMPERATURE,
               temperature_C=servo.temperature)
    rows.add(f'{name} torque', 'its torque is on, although no driver has the port open',
             warn='a program left it on: switch it off with the joint bridge, or cut its supply'
             if servo.torque else '')
    rows.add(f'{name} turn', f'ambiguous: {doubts}',
             fail=f'turn it by hand to within +-{limit:.2f} rad, cables untwisted: {GUIDE}'
             if doubts else '', position_rad=angle)
    findings += [row for row in rows if row.remedy]


def _check_answers(findings, link, servos):
    """Add a finding about the loss and the duration of answers to single reads."""
    asked, times = ROUNDS * len(servos), []
    for servo in servos * ROUNDS:
        started = time.perf_counter()
        try:
            link.read(servo.identifier, xc330.PRESENT_POSITION)
            times.append(1e3 * (time.perf_counter() - started))
        except xc330.ServoBusError:
            continue
    missing = asked - len(times)
    median, slowest = (np.median(times), max(times)) if times else (np.nan, np.nan)
    findings.grade(
        BUS, f'{len(times)} of {asked} reads answered, {median:.1f} ms each (median), '
        f'longest {slowest:.1f} ms, at {link.baud_rate} bit/s', missing / asked,
        'check latency timer, connectors, ground, ends of the chain, two servos with one id, the '
        'load of the computer', warn=LOSS, fail=LOSS_FAIL,
        asked=asked, missing=missing, median_ms=float(median), longest_ms=float(slowest),
        baud_rate=link.baud_rate)


# --- motor board --------------------------------------------------------------------------------

def check_board(parameters: MotorBoardParameters, robot: RobotParameters, seconds: float,
                graph: ObservedGraph | None = None) -> Findings:
    """Check the motor board, listening for ``seconds``; otherwise as :func:`check_servos`."""
    findings = Findings()
    board = MotorBoard(parameters, robot)
    if not open_port(findings, board, 'board', parameters.port, 'rotor_bridge', graph):
        return findings
    try:
        battery, rotors, receptions = _listen(board, seconds)
        status, link = board.state.status, board.link()
    finally:
        board.close()
    if status is None:
        findings.add(BOARD, f"no heartbeat; {link['bytes']} bytes, {link['received']} good "
                     f"packets, {link['foreign']} of other senders", fail=(
                         'another device sends MAVLink: docs/reference/firmware.md has the '
                         'identity of the board' if link['foreign'] else
                         f'wrong baud rate (here {parameters.baud} bit/s), or another firmware or '
                         'device' if link['bytes'] else
                         "check the board's power, the cable, TX and RX swapped, another port"))
        return findings
    _check_status(findings, status)
    _check_power(findings, battery, rotors, robot.battery.cells)
    _check_link(findings, link, receptions)
    return findings


def _listen(board, seconds):
    """Newest battery and rotors; packets sent, and the board's counts, at each report of these."""
    rotors = battery = None
    receptions = []
    started = time.monotonic()
    while (passed := time.monotonic() - started) < seconds:
        new_battery, new_rotors = board.poll()
        rotors, battery = new_rotors or rotors, new_battery or battery
        reception = board.state.reception
        # The restart of our sequence numbers looks like lost packets to the board.
        if reception and passed > SETTLING and \
                (not receptions or reception is not receptions[-1][1]):
            receptions.append((board.link()['sent'], reception))
        time.sleep(POLL_PERIOD)
    return battery, rotors, receptions


def _check_status(findings, status):
    stopped = '' if status.stop_reason == 'none' else f', last disarmed: {status.stop_reason}'
    findings.add(
        'board firmware', f'contract {status.contract}, {status.state}{stopped}',
        contract=status.contract, state=status.state,
        fail='' if status.contract == CONTRACT_VERSION else
        f'flash a firmware of contract {CONTRACT_VERSION}: docs/reference/firmware.md',
        warn='it was armed by another program and is disarmed now: find that program'
        if status.armed else '')
    blocking = [condition for condition in status.conditions if condition != NO_HOST_HEARTBEAT]
    receives = NO_HOST_HEARTBEAT not in status.conditions
    findings.add('board receives host', 'yes' if receives else NO_HOST_HEARTBEAT,
                 fail='' if receives else "check the computer's TX wire")
    findings.add('board ready to arm', ', '.join(blocking) or 'yes',
                 fail='charge the battery, check the ESCs, stop programs that command thrust'
                 if blocking else '')


def _check_power(findings, battery, rotors, cells):
    if battery is None:
        findings.add('battery', 'no plausible voltage',
                     fail="check the board's voltage divider and its calibration")
    else:
        cell = battery.voltage / cells
        current = '' if np.isnan(battery.current) else f', {battery.current:.2f} A'
        findings.grade(
            'battery', f'{battery.voltage:.2f} V, {cell:.2f} V a cell of {cells}{current}', cell,
            'charge it' if cell < CELL[0] else
            'calibrate the voltage, or correct battery.cells in the robot file',
            warn=CELL, fail=CELL_FAIL, voltage_V=battery.voltage, cell_V=cell,
            current_A=battery.current)
    if rotors is None:
        findings.add('ESC telemetry', 'no ESC_STATUS',
                     fail='the firmware must send it: docs/reference/firmware.md')
        return
    for k in range(4):
        online, faults = bool(np.isfinite(rotors.rpm[k])), ', '.join(rotors.failures[k])
        temperature = '' if np.isnan(rotors.temperature[k]) else f'{rotors.temperature[k]:.0f} C, '
        findings.add(
            f'ESC of rotor {k + 1}', f"{temperature}{rotors.voltage[k]:.1f} V, "
            f"{faults or 'no fault'}" if online else 'offline',
            fail='check its power, its signal and telemetry wires, and whether the rotor turns '
            'freely' if faults or not online else '',
            temperature_C=rotors.temperature[k], voltage_V=rotors.voltage[k],
            error_count=int(rotors.error_count[k]))


def _check_link(findings, link, receptions):
    """Add findings about the clock and the packets in both directions."""
    offset, uncertainty = link['clock_offset_s'], link['clock_uncertainty_ms'] / 1e3
    findings.grade(
        'board clock', f'offset {offset:.3f} s +- {1e3 * uncertainty:.2f} ms'
        if np.isfinite(uncertainty) else 'offset unknown: no answer to TIMESYNC', uncertainty,
        "check the computer's TX wire, the latency timer of the adapter and the load of the "
        'computer; the firmware must answer TIMESYNC', warn=CLOCK, fail=CLOCK_FAIL,
        offset_s=offset, uncertainty_s=uncertainty)
    counts = [('link from the board', link['lost'], link['bad_crc'], link['received'])]
    if len(receptions) > 1:
        (before, first), (after, last) = receptions[0], receptions[-1]
        lost, bad_crc = (last[name] - first[name] for name in ('lost', 'bad_crc'))
        counts.append(('link to the board', lost, bad_crc, max(0, after - before - lost)))
    else:
        findings.add('link to the board', f"{len(receptions)} reports of the board's reception, "
                     'two are needed', warn='increase the time: --seconds 4')
    for item, lost, bad_crc, good in counts:
        bad = max(lost, bad_crc)    # a corrupt packet also leaves a gap in the sequence numbers
        findings.grade(
            item, f'{bad} of {good + bad} packets lost or corrupt', bad / max(1, good + bad),
            'check cable, ground, distance to the motor wires, baud rate', warn=LOSS,
            fail=LOSS_FAIL, lost=lost, bad_crc=bad_crc, good=good)
