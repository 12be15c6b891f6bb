"""Bring-up of the servo bus: only pings and reads, so that nothing moves and nothing is set."""

from __future__ import annotations

from pathlib import Path
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
from beetle_omni_ros.bringup.heard import Heard
from beetle_omni_ros.bringup.limits import CheckLimits, ServoLimits
from beetle_omni_ros.bringup.port import latency_finding, port_finding, PROC, SYS
from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_turns import certain_limit, settle
from beetle_omni_ros.robot.parameters import JointParameters

PORT, BUS, BRIDGE = 'servo port', 'servo bus', 'joint_bridge'
ROUNDS = 50             # reads of each servo, to see how quick and how sure the answers are
OTHER_IDS = range(21)   # looked for at every baud rate when a servo is missing


def check_servos(parameters: ServoBusParameters, joints: JointParameters, limits: CheckLimits,
                 heard: Heard | None = None, sys_root: Path = SYS,
                 proc_root: Path = PROC) -> list[Finding]:
    """
    Look at the bus and its servos.

    Args:
        parameters: of the bus.
        joints: for the travel of the tilts.
        limits: of what is well.
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
        from beetle_omni_ros.drivers.servo_link import ServoLink
        from beetle_omni_ros.drivers.servo_port import PortLost
    except ModuleNotFoundError as error:
        return [port, missing_library(BUS, error, 'hardware')]
    link = ServoLink(parameters.port, parameters.baud_rate, parameters.timing.reply)
    try:
        link.open()
        latency = latency_finding('servo port latency timer', parameters.port,
                                  limits.link.latency_timer, sys_root)
        return [port, latency, *_of_bus(link, parameters, joints, limits.servos)]
    except PortLost as error:
        return [port, Finding(BUS, FAIL, f'{parameters.port}: {error}',
                              'look at cable and adapter: docs/how-to/hardware.md')]
    finally:
        link.close()


def _of_bus(link, parameters, joints, limits):
    from beetle_omni_ros.drivers.servo_setup import examine
    from beetle_omni_ros.drivers.servo_state import make_servos
    servos = make_servos(parameters)
    with link.patient():
        looks = [examine(link, servo) for servo in servos]
        torques = [_torque(link, servo) if look.model is not None else None
                   for servo, look in zip(servos, looks, strict=True)]
    present = [servo for servo, look in zip(servos, looks, strict=True) if look.model is not None]
    answers = [_answers(link, present, limits)] if present else []
    strangers = []
    if len(present) < len(servos):
        strangers = _strangers(link, parameters)
        if not present and not strangers:
            return [Finding(BUS, FAIL, 'no servo answers, at no baud rate',
                            "look at the servos' supply (their LEDs blink once when it comes on) "
                            'and at the data cable')]
    findings = [*answers]
    for k, (servo, look) in enumerate(zip(servos, looks, strict=True)):
        findings.append(_of_servo(look, parameters, strangers))
        if look.position is not None:
            findings += _troubles(look, torques[k], limits)
            findings += _turn(servo, look, parameters, joints, k)
    return findings


def _torque(link, servo):
    from beetle_omni_ros.drivers.servo_link import ServoBusError
    try:
        return bool(link.read(servo.identifier, registers.TORQUE_ENABLE))
    except ServoBusError:
        return None


def _of_servo(look, parameters, strangers):
    """The servo itself: does it answer, is it the right one, is it healthy."""
    values = {'id': look.identifier, 'model': look.model, 'firmware': look.firmware,
              'baud_rate': look.baud_rate, 'supply_V': look.voltage,
              'temperature_C': look.temperature, 'position_rad': look.position}
    facts = ''
    if look.position is not None:
        facts = (f'id {look.identifier}, model {look.model}, firmware {look.firmware}, '
                 f'{look.voltage:.1f} V, {look.temperature:.0f} C, {look.position:+.2f} rad')
    if look.ok:
        return Finding(look.name, OK, facts, values=values)
    found = f'id {look.identifier} {look.problem}' if not facts else f'{look.problem}; {facts}'
    remedy = look.remedy
    if look.model is None:
        remedy = _where_it_may_be(look.identifier, parameters, strangers) or \
            'look at its connector, and at those before it in the chain'
    return Finding(look.name, FAIL, found, remedy, values)


def _strangers(link, parameters):
    """Look for (baud rate, ID, model) of servos that are not where they should be."""
    from beetle_omni_ros.drivers.servo_setup import scan
    link.close()
    expected = {(parameters.baud_rate, int(name)) for name in parameters.ids}
    return [found for found in scan(parameters, OTHER_IDS) if found[:2] not in expected]


def _where_it_may_be(identifier, parameters, strangers):
    """Explain what was found in place of a missing servo; '' nothing."""
    for baud_rate, other, _ in strangers:
        if other == identifier:
            return (f'id {other} answers at {baud_rate} bit/s: set Baud Rate(8) to code '
                    f'{registers.BAUD_CODES[parameters.baud_rate]}, '
                    f'{parameters.baud_rate} bit/s, with DYNAMIXEL Wizard')
    others = [f'id {other} at {baud_rate} bit/s' for baud_rate, other, _ in strangers]
    if others:
        return (f"{', '.join(others)} answers, which nobody expects: is it this one? Set id "
                f'{identifier} and {parameters.baud_rate} bit/s with DYNAMIXEL Wizard, that '
                'servo alone on the bus')
    return ''


def _troubles(look, torque, limits: ServoLimits):
    """What is not as it should be with a servo that answers."""
    name, findings = look.name, []
    if look.firmware < registers.FIRST_FAST_FIRMWARE:
        findings.append(Finding(
            f'{name} firmware', WARN, f'{look.firmware}, before '
            f'{registers.FIRST_FAST_FIRMWARE}: no fast sync read, feedback of all servos takes '
            'longer', 'update it with DYNAMIXEL Wizard', {'firmware': look.firmware}))
    supply = {'supply_V': look.voltage}
    if not limits.supply_fail_low <= look.voltage <= limits.supply_high:
        findings.append(Finding(
            f'{name} supply', FAIL, f'{look.voltage:.1f} V, allowed are '
            f'{limits.supply_fail_low:g} to {limits.supply_high:g} V',
            'set the regulator to 11.1 to 12 V', supply))
    elif look.voltage < limits.supply_low:
        findings.append(Finding(
            f'{name} supply', WARN, f'{look.voltage:.1f} V: slower and weaker than identified',
            'set the regulator to 11.1 to 12 V; drop over a thin cable?', supply))
    if look.temperature > limits.temperature_high:
        findings.append(Finding(
            f'{name} temperature', WARN, f'{look.temperature:.0f} C', 'let it cool; does it '
            'push against something?', {'temperature_C': look.temperature}))
    if torque:
        findings.append(Finding(
            f'{name} torque', WARN, 'its torque is on, although no driver has the port',
            'a program left it so: switch it off with the joint bridge, or cut its supply'))
    return findings


def _turn(servo, look, parameters, joints, k):
    """Whether the joint's angle is certain, as the driver will ask before it gives torque."""
    servo.position = look.position
    confirmed = [parameters.confirmed_tilts[k]] if parameters.confirm_tilts else None
    doubts = settle([servo], joints.position_limit, confirmed)
    if doubts:
        limit = certain_limit(joints.position_limit)
        return [Finding(f'{look.name} turn', FAIL, f'ambiguous: {doubts}', 'turn it by hand to '
                        f'within +-{limit:.2f} rad, cables untwisted; or set confirmed_tilts and '
                        'confirm_tilts: docs/how-to/hardware.md', {'position_rad': look.position})]
    if confirmed:
        return [Finding(f'{look.name} turn', WARN, f'taken as {servo.position:+.2f} rad because '
                        'confirm_tilts is set', 'reset confirm_tilts once it is parked',
                        {'position_rad': servo.position})]
    return []


def _answers(link, servos, limits: ServoLimits):
    """Ask as the loop does; how many answers are missing, and how long do they take."""
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
    return graded(BUS, found, missing / asked, 'latency timer, connectors, ground, ends of the '
                  'chain, two servos with one id; a busy computer', warn=limits.answer_loss,
                  fail=limits.answer_loss_fail,
                  values={'asked': asked, 'missing': missing, 'median_ms': median,
                          'longest_ms': slowest, 'baud_rate': link.baud_rate})
