"""Check of the servo bus by pings and reads only: nothing moves and no setting changes."""

import time

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
from beetle_omni_ros.bringup.limits import CheckLimits, ServoLimits
from beetle_omni_ros.bringup.port import latency_finding, port_finding
from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_registers import settle, unambiguous_limit
from beetle_omni_ros.robot.parameters import JointParameters

BUS, BRIDGE = 'servo bus', 'joint_bridge'
ROUNDS = 50             # reads of each servo to measure answer time and loss
OTHER_IDS = range(21)   # searched at every baud rate if a servo is missing


def check_servos(parameters: ServoBusParameters, joints: JointParameters, limits: CheckLimits,
                 graph: ObservedGraph | None = None) -> list[Finding]:
    """
    Check the bus and its servos. A failure may end the list of findings.

    ``graph`` is the observed ROS graph, used if a bridge has the port open.
    """
    port = port_finding('servo port', parameters.port)
    if port.level != OK:
        return bridge_findings(port, BRIDGE, graph)
    try:
        from beetle_omni_ros.drivers.serial_port import SerialPortError
        from beetle_omni_ros.drivers.servo_link import ServoLink
    except ModuleNotFoundError as error:
        return [port, missing_library(BUS, error, 'hardware')]
    link = ServoLink(parameters.port, parameters.baud_rate, parameters.timing.reply)
    try:
        link.open()
        latency = latency_finding('servo port latency timer', parameters.port,
                                  limits.link.latency_timer)
        return [port, latency, *_of_bus(link, parameters, joints, limits.servos)]
    except SerialPortError as error:
        return [port, Finding(BUS, FAIL, str(error),
                              'check cable and adapter: docs/how-to/hardware.md')]
    finally:
        link.close()


def _of_bus(link, parameters, joints, limits):
    from beetle_omni_ros.drivers.servo_bus import examine, make_servos
    servos = make_servos(parameters)
    with link.patient():
        problems = [examine(link, servo) for servo in servos]
        present = [servo for servo in servos if servo.model is not None]
        for servo in present:
            servo.torque = _torque(link, servo)
    findings = [_answers(link, present, limits)] if present else []
    misplaced = []
    if len(present) < len(servos):
        link.close()
        misplaced = _misplaced(parameters)
        if not present and not misplaced:
            return [Finding(BUS, FAIL, 'no servo answers at any baud rate',
                            "check the servos' supply (their LEDs blink once at power-up) "
                            'and the data cable')]
    for k, (servo, (problem, remedy)) in enumerate(zip(servos, problems, strict=True)):
        if servo.model is None:
            remedy = _remedy_of_missing(servo.identifier, parameters, misplaced)
        findings.append(_of_servo(servo, link.baud_rate, problem, remedy))
        if servo.firmware is not None:
            findings += _of_health(servo, limits)
            findings += _of_turn(servo, parameters, joints, k)
    return findings


def _torque(link, servo):
    from beetle_omni_ros.drivers.servo_link import ServoBusError
    try:
        return bool(link.read(servo.identifier, registers.TORQUE_ENABLE))
    except ServoBusError:
        return None


def _of_servo(servo, baud_rate, problem, remedy):
    """Finding whether a servo answers, has the right model and reports no error."""
    read = servo.firmware is not None
    values = {'id': servo.identifier, 'model': servo.model, 'firmware': servo.firmware,
              'baud_rate': baud_rate if read else None,
              'supply_V': servo.voltage if read else None,
              'temperature_C': servo.temperature if read else None,
              'position_rad': servo.position if read else None}
    facts = f'id {servo.identifier}, model {servo.model}, firmware {servo.firmware}, ' \
        f'{servo.voltage:.1f} V, {servo.temperature:.0f} C, {servo.position:+.2f} rad'
    if not problem:
        return Finding(servo.name, OK, facts, values=values)
    found = f'{problem}; {facts}' if read else f'id {servo.identifier} {problem}'
    return Finding(servo.name, FAIL, found, remedy, values)


def _misplaced(parameters):
    """Find (baud rate, ID, model) of servos with an unexpected ID or baud rate."""
    from beetle_omni_ros.drivers.serial_port import SerialPortError
    from beetle_omni_ros.drivers.servo_link import ServoBusError, ServoLink
    found, ids = [], {int(name) for name in parameters.ids}
    for baud_rate in registers.BAUD_CODES:
        link = ServoLink(parameters.port, baud_rate, max(parameters.timing.reply, 0.005))
        try:
            link.open()
            for identifier in sorted(ids.union(OTHER_IDS)):
                if baud_rate == parameters.baud_rate and identifier in ids:
                    continue
                try:
                    found.append((baud_rate, identifier, link.ping(identifier)))
                except ServoBusError:
                    continue
        except SerialPortError:
            continue    # some adapters lack some baud rates
        finally:
            link.close()
    return found


def _remedy_of_missing(identifier, parameters, misplaced):
    for baud_rate, other, _ in misplaced:
        if other == identifier:
            return (f'id {other} answers at {baud_rate} bit/s: set Baud Rate(8) to code '
                    f'{registers.BAUD_CODES[parameters.baud_rate]}, '
                    f'{parameters.baud_rate} bit/s, with DYNAMIXEL Wizard')
    others = [f'id {other} at {baud_rate} bit/s' for baud_rate, other, _ in misplaced]
    if others:
        return (f"unexpected answer of {', '.join(others)}; if this is the servo, set id "
                f'{identifier} and {parameters.baud_rate} bit/s with DYNAMIXEL Wizard, with '
                'that servo alone on the bus')
    return 'check its connector, and those before it in the chain'


def _of_health(servo, limits: ServoLimits):
    """Findings about supply, temperature and torque; empty without a problem."""
    name, findings = servo.name, []
    supply = {'supply_V': servo.voltage}
    if not limits.supply_fail_low <= servo.voltage <= limits.supply_high:
        findings.append(Finding(
            f'{name} supply', FAIL, f'{servo.voltage:.1f} V, allowed are '
            f'{limits.supply_fail_low:g} to {limits.supply_high:g} V',
            'set the regulator to 11.1 to 12 V', supply))
    elif servo.voltage < limits.supply_low:
        findings.append(Finding(
            f'{name} supply', WARN, f'{servo.voltage:.1f} V: slower and weaker than identified',
            'set the regulator to 11.1 to 12 V; check the drop over thin cables', supply))
    if servo.temperature > limits.temperature_high:
        findings.append(Finding(
            f'{name} temperature', WARN, f'{servo.temperature:.0f} C', 'let it cool; check what '
            'blocks the joint', {'temperature_C': servo.temperature}))
    if servo.torque:
        findings.append(Finding(
            f'{name} torque', WARN, 'its torque is on, although no driver has the port open',
            'a program left it on: switch it off with the joint bridge, or cut its supply'))
    return findings


def _of_turn(servo, parameters, joints, k):
    """Finding if the turn of the joint is ambiguous, by the rule of the driver."""
    read = servo.position
    confirmed = [parameters.confirmed_tilts[k]] if parameters.confirm_tilts else None
    doubts = settle([servo], joints.position_limit, confirmed)
    if doubts:
        limit = unambiguous_limit(joints.position_limit)
        return [Finding(f'{servo.name} turn', FAIL, f'ambiguous: {doubts}', 'turn it by hand to '
                        f'within +-{limit:.2f} rad, cables untwisted; or set confirmed_tilts and '
                        'confirm_tilts: docs/how-to/hardware.md',
                        {'position_rad': read})]
    if confirmed:
        return [Finding(f'{servo.name} turn', WARN, f'taken as {servo.position:+.2f} rad because '
                        'confirm_tilts is set', 'reset confirm_tilts once it is parked',
                        {'position_rad': servo.position})]
    return []


def _answers(link, servos, limits: ServoLimits):
    """Finding about the loss and the duration of answers to single reads."""
    from beetle_omni_ros.drivers.servo_link import ServoBusError
    asked, missing, times = 0, 0, []
    for _ in range(ROUNDS):
        for servo in servos:
            started = time.perf_counter()
            asked += 1
            try:
                link.read(servo.identifier, registers.PRESENT_POSITION)
                times.append(time.perf_counter() - started)
            except ServoBusError:
                missing += 1
    times.sort()
    median = 1e3 * times[len(times) // 2] if times else float('nan')
    slowest = 1e3 * times[-1] if times else float('nan')
    found = (f'{asked - missing} of {asked} reads answered, {median:.1f} ms each (median), '
             f'longest {slowest:.1f} ms, at {link.baud_rate} bit/s')
    return graded(BUS, found, missing / asked, 'check latency timer, connectors, ground, ends '
                  'of the chain, two servos with one id, the load of the computer',
                  warn=limits.answer_loss, fail=limits.answer_loss_fail,
                  values={'asked': asked, 'missing': missing, 'median_ms': median,
                          'longest_ms': slowest, 'baud_rate': link.baud_rate})
