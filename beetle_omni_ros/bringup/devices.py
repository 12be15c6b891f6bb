"""
Checks of ports, servos and motor board for `beetle_omni check`.

Servos get pings and reads only: nothing moves and no setting changes. The motor board is listened
to by its driver; no rotor turns, and an armed board is disarmed at the end.
"""

import grp
import os
from pathlib import Path
import pwd
import stat
import time

import numpy as np

from beetle_omni_ros.bringup.findings import closed_port, Findings, ObservedGraph
from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.robot.parameters import JointParameters, RobotParameters

SYS = Path('/sys')
BUS, BOARD = 'servo bus', 'motor board'
ROUNDS = 50             # reads of each servo to measure answer time and loss
POLL_PERIOD = 0.02      # [s] between polls of the board
SETTLING = 0.3          # [s] until the board has received several of our packets
LATENCY_TIMER = 1       # [ms] of FTDI adapters, docs/how-to/hardware.md
LOSS, LOSS_FAIL = 0.01, 0.1     # [-] share of lost answers or packets; at 0.1 the joints jerk
# [V] supply of a servo: the smallest of the XC330-T181-T by its manual; half a volt below the
# recommended 11.1 V, it is weaker and slower; 5 % above the largest.
SUPPLY_FAIL_LOW, SUPPLY_LOW, SUPPLY_HIGH = 6.5, 10.5, 12.6
TEMPERATURE_HIGH = 55.0     # [C] at rest a servo has nearly room temperature; at 70 it shuts down
# [V] cell at rest: smallest for arming (supervisor.yaml); about half empty; above a full LiPo
# cell, 4.2 V, the calibration or the number of cells is wrong.
CELL_FAIL_LOW, CELL_LOW, CELL_HIGH = 3.5, 3.7, 4.25


# --- ports --------------------------------------------------------------------------------------

def unusable_port(path: str) -> tuple[str, str]:
    """Check a port without opening it; return what is wrong and the remedy, '' for nothing."""
    try:
        status = os.stat(path)
    except PermissionError:
        return f'{path}: no permission for its folder', 'ask the owner of the folder'
    except OSError:
        if os.path.islink(path):
            return (f'{path}: the link leads to {os.readlink(path)}, which does not exist',
                    'plug the adapter in again')
        from beetle_omni_ros.drivers.serial_port import usb_ports
        if ports := '; '.join(f'{device}: {product}' for device, product in usb_ports().items()):
            return (f'{path}: no such port', f'name one of the present ports ({ports}), or give '
                    'it this name by the udev rule of docs/how-to/hardware.md')
        return (f'{path}: no such port', 'no USB serial port is present: plug the adapter in, '
                'check `dmesg`')
    if not stat.S_ISCHR(status.st_mode):
        return f'{path}: no serial port', 'name the device, such as /dev/ttyUSB0'
    if not os.access(path, os.R_OK | os.W_OK):
        user, group = pwd.getpwuid(os.geteuid()).pw_name, grp.getgrgid(status.st_gid).gr_name
        return (f'{path}: no permission for {user} ({stat.filemode(status.st_mode)}, group '
                f'{group})', f'sudo usermod -aG {group} {user}, then log out and in again; or '
                'install the udev rule of docs/how-to/hardware.md: GROUP="dialout", MODE="0660"')
    return '', ''


def _opened_port(findings, device, path):
    """Add findings about an open port: its name, and the latency timer of a USB adapter."""
    from beetle_omni_ros.drivers.serial_port import usb_ports
    real = os.path.realpath(path)
    names = [path if real == path else f'{path} ({real})', usb_ports().get(real)]
    findings.add(f'{device} port', ', '.join(filter(None, names)))
    file = SYS / 'bus' / 'usb-serial' / 'devices' / Path(real).name / 'latency_timer'
    try:
        timer = int(file.read_text())
    except (OSError, ValueError):
        findings.add(f'{device} port latency timer', 'none: no FTDI adapter')
        return
    findings.add(f'{device} port latency timer', f'{timer} ms', latency_timer_ms=timer,
                 fail=f'each answer waits for it: echo {LATENCY_TIMER} | sudo tee {file}; '
                 'permanently: the udev rule of docs/how-to/hardware.md'
                 if timer > LATENCY_TIMER else '')


# --- servos -------------------------------------------------------------------------------------

def check_servos(parameters: ServoBusParameters, joints: JointParameters,
                 graph: ObservedGraph | None = None) -> Findings:
    """
    Check the bus and its servos. A failure may end the list of findings.

    ``graph`` is the observed ROS graph, used if a bridge has the port open.
    """
    findings = Findings()
    try:
        from beetle_omni_ros.drivers.serial_port import SerialPortError
        from beetle_omni_ros.drivers.servo_link import ServoLink
    except ModuleNotFoundError as error:
        findings.missing(BUS, error, 'hardware')
        return findings
    found, remedy = unusable_port(parameters.port)
    if found:
        return closed_port('servo port', found, remedy, 'joint_bridge', graph)
    link = ServoLink(parameters.port, parameters.baud_rate, parameters.timing.reply)
    try:
        link.open()
    except SerialPortError as error:
        return closed_port('servo port', str(error), 'docs/how-to/hardware.md', 'joint_bridge',
                           graph)
    try:
        _opened_port(findings, 'servo', parameters.port)
        _check_bus(findings, link, parameters, joints)
    except SerialPortError as error:
        findings.add(BUS, str(error), fail='check cable and adapter: docs/how-to/hardware.md')
    finally:
        link.close()
    return findings


def _check_bus(findings, link, parameters, joints):
    from beetle_omni_ros.drivers.servo_bus import examine, make_servos
    from beetle_omni_ros.drivers.servo_link import ServoBusError
    servos = make_servos(parameters)
    with link.patient():
        problems = [examine(link, servo) for servo in servos]
        present = [servo for servo in servos if servo.model is not None]
        for servo in present:
            try:
                servo.torque = bool(link.read(servo.identifier, registers.TORQUE_ENABLE))
            except ServoBusError:
                servo.torque = None
    if present:
        _check_answers(findings, link, present)
    else:
        findings.add(BUS, f'no servo answers at {link.baud_rate} bit/s', fail="check the servos' "
                     'supply (their LEDs blink once at power-up), the data cable, and with '
                     'DYNAMIXEL Wizard their baud rates')
        return
    for k, (servo, (problem, remedy)) in enumerate(zip(servos, problems, strict=True)):
        if servo.model is None:
            findings.add(servo.name, f'id {servo.identifier} {problem}',
                         fail='check its connector, and those before it in the chain; search '
                         'for its id and baud rate with DYNAMIXEL Wizard', id=servo.identifier)
            continue
        read = servo.firmware is not None
        facts = f'id {servo.identifier}, model {servo.model}, firmware {servo.firmware}, ' \
            f'{servo.voltage:.1f} V, {servo.temperature:.0f} C, {servo.position:+.2f} rad' \
            if read else f'id {servo.identifier}'
        findings.add(servo.name, f'{problem}; {facts}' if problem else facts,
                     fail=remedy if problem else '', id=servo.identifier, model=servo.model,
                     firmware=servo.firmware, baud_rate=link.baud_rate, **({
                         'supply_V': servo.voltage, 'temperature_C': servo.temperature,
                         'position_rad': servo.position} if read else {}))
        if read:
            _check_health(findings, servo)
            _check_turn(findings, servo, parameters, joints, k)


def _check_health(findings, servo):
    """Add findings about supply, temperature and torque; none without a problem."""
    name = servo.name
    if not SUPPLY_FAIL_LOW <= servo.voltage <= SUPPLY_HIGH:
        findings.add(f'{name} supply', f'{servo.voltage:.1f} V, allowed are '
                     f'{SUPPLY_FAIL_LOW:g} to {SUPPLY_HIGH:g} V',
                     fail='set the regulator to 11.1 to 12 V', supply_V=servo.voltage)
    elif servo.voltage < SUPPLY_LOW:
        findings.add(f'{name} supply', f'{servo.voltage:.1f} V: slower and weaker than identified',
                     warn='set the regulator to 11.1 to 12 V; check the drop over thin cables',
                     supply_V=servo.voltage)
    if servo.temperature > TEMPERATURE_HIGH:
        findings.add(f'{name} temperature', f'{servo.temperature:.0f} C', warn='let it cool; '
                     'check what blocks the joint', temperature_C=servo.temperature)
    if servo.torque:
        findings.add(f'{name} torque', 'its torque is on, although no driver has the port open',
                     warn='a program left it on: switch it off with the joint bridge, or cut its '
                     'supply')


def _check_turn(findings, servo, parameters, joints, k):
    """Add a finding if the turn of the joint is ambiguous, by the rule of the driver."""
    read = servo.position
    confirmed = [parameters.confirmed_tilts[k]] if parameters.confirm_tilts else None
    if doubts := registers.settle([servo], joints.position_limit, confirmed):
        limit = registers.unambiguous_limit(joints.position_limit)
        findings.add(f'{servo.name} turn', f'ambiguous: {doubts}', fail='turn it by hand to '
                     f'within +-{limit:.2f} rad, cables untwisted; or set confirmed_tilts and '
                     'confirm_tilts: docs/how-to/hardware.md', position_rad=read)
    elif confirmed:
        findings.add(f'{servo.name} turn', f'taken as {servo.position:+.2f} rad because '
                     'confirm_tilts is set', warn='reset confirm_tilts once it is parked',
                     position_rad=servo.position)


def _check_answers(findings, link, servos):
    """Add a finding about the loss and the duration of answers to single reads."""
    from beetle_omni_ros.drivers.servo_link import ServoBusError
    asked, times = ROUNDS * len(servos), []
    for servo in servos * ROUNDS:
        started = time.perf_counter()
        try:
            link.read(servo.identifier, registers.PRESENT_POSITION)
            times.append(1e3 * (time.perf_counter() - started))
        except ServoBusError:
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
    """
    Check the motor board, listening for ``seconds``. A failure may end the list of findings.

    ``graph`` is the observed ROS graph, used if a bridge has the port open.
    """
    findings = Findings()
    try:
        from beetle_omni_ros.drivers.motor_board import MotorBoard
        from beetle_omni_ros.drivers.serial_port import SerialPortError
    except ModuleNotFoundError as error:
        findings.missing(BOARD, error, 'hardware')
        return findings
    found, remedy = unusable_port(parameters.port)
    if found:
        return closed_port('board port', found, remedy, 'rotor_bridge', graph)
    board = MotorBoard(parameters, robot)
    try:
        board.open()
    except SerialPortError as error:
        return closed_port('board port', str(error), 'docs/how-to/hardware.md', 'rotor_bridge',
                           graph)
    try:
        battery, rotors, receptions = _listen(board, seconds)
        _opened_port(findings, 'board', parameters.port)
        status, link = board.state.status, board.link()
    finally:
        board.close()
    if status is None:
        findings.add(BOARD, f"no heartbeat; {link['bytes']} bytes, {link['received']} good "
                     f"packets, {link['foreign']} of other senders",
                     fail=_remedy_of_silence(link, parameters))
        return findings
    _check_status(findings, status)
    _check_battery(findings, battery, robot.battery.cells)
    _check_escs(findings, rotors)
    _check_clock(findings, link, parameters)
    _check_link(findings, link, receptions)
    return findings


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


def _remedy_of_silence(link, parameters):
    if link['foreign']:
        return (f'another device sends MAVLink; expected system '
                f'{parameters.board_system}, component {parameters.board_component}: '
                'params/motor_board.yaml')
    if link['bytes']:
        return f'wrong baud rate (here {parameters.baud} bit/s), or another firmware or device'
    return "check the board's power, the cable, TX and RX swapped, another port"


def _check_status(findings, status):
    from beetle_omni_ros.drivers.motor_board_state import CONTRACT_VERSION, NO_HOST_HEARTBEAT
    found = f'contract {status.contract}, {status.state}'
    if status.stop_reason != 'none':
        found += f', last disarmed: {status.stop_reason}'
    findings.add(
        'board firmware', found, contract=status.contract, state=status.state,
        fail='' if status.contract == CONTRACT_VERSION else
        f'flash a firmware of contract {CONTRACT_VERSION}: docs/reference/firmware.md',
        warn='it was armed by another program and is disarmed now: find that program'
        if status.armed else '')
    blocking = [condition for condition in status.conditions if condition != NO_HOST_HEARTBEAT]
    receives = NO_HOST_HEARTBEAT not in status.conditions
    findings.add('board receives host', 'yes' if receives else NO_HOST_HEARTBEAT,
                 fail='' if receives else "check the computer's TX wire, and host_system and "
                 'host_component in params/motor_board.yaml')
    findings.add('board ready to arm', ', '.join(blocking) or 'yes',
                 fail='charge the battery, check the ESCs, stop programs that command thrust'
                 if blocking else '')


def _check_battery(findings, battery, cells):
    if battery is None:
        findings.add('battery', 'no plausible voltage',
                     fail="check the board's voltage divider and its calibration")
        return
    cell = battery.voltage / cells
    current = '' if np.isnan(battery.current) else f', {battery.current:.2f} A'
    findings.add(
        'battery', f'{battery.voltage:.2f} V, {cell:.2f} V a cell of {cells}{current}',
        fail='calibrate the voltage, or correct battery.cells in the robot file'
        if cell > CELL_HIGH else 'charge it' if cell < CELL_FAIL_LOW else '',
        warn='charge it' if cell < CELL_LOW else '',
        voltage_V=battery.voltage, cell_V=cell, current_A=battery.current)


def _check_escs(findings, rotors):
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


def _check_clock(findings, link, parameters):
    offset, uncertainty = link['clock_offset_s'], link['clock_uncertainty_ms'] / 1e3
    limit = parameters.clock_uncertainty_limit
    findings.grade(
        'board clock', f'offset {offset:.3f} s +- {1e3 * uncertainty:.2f} ms'
        if np.isfinite(uncertainty) else 'offset unknown: no answer to TIMESYNC', uncertainty,
        "check the computer's TX wire, the latency timer of the adapter and the load of the "
        'computer; the firmware must answer TIMESYNC', warn=limit / 2, fail=limit,
        offset_s=offset, uncertainty_s=uncertainty)


def _check_link(findings, link, receptions):
    counts = [('link from the board', link['lost'], link['bad_crc'], link['received'])]
    if len(receptions) > 1:
        (before, first), (after, last) = receptions[0], receptions[-1]
        lost, bad_crc = (last[name] - first[name] for name in ('lost', 'bad_crc'))
        counts.append(('link to the board', lost, bad_crc, max(0, after - before - lost)))
    for item, lost, bad_crc, good in counts:
        bad = max(lost, bad_crc)    # a corrupt packet also leaves a gap in the sequence numbers
        findings.grade(
            item, f'{bad} of {good + bad} packets lost or corrupt', bad / max(1, good + bad),
            'check cable, ground, distance to the motor wires, baud rate', warn=LOSS,
            fail=LOSS_FAIL, lost=lost, bad_crc=bad_crc, good=good)
    if len(receptions) < 2:
        findings.add('link to the board', f"{len(receptions)} reports of the board's reception, "
                     'two are needed', warn='increase the time: --seconds 4')
