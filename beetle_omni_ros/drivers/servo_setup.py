"""Bring-up of the bus: who is there, is it the right servo, and are its settings ours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_link import NoAnswer, Refused, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_registers import Register
from beetle_omni_ros.drivers.servo_turns import TURN

# A servo that has restarted since it was configured has its default of 1200 here. The register
# acts in velocity mode alone.
MARK = (registers.VELOCITY_I, 1201)


@dataclass(frozen=True, slots=True)
class ServoFinding:
    """
    What :func:`check` found about one servo.

    Attributes:
        problem: '' when it is fit for use.
        remedy: what to do about the problem.

    """

    name: str
    identifier: int
    model: int | None = None
    firmware: int | None = None
    baud_rate: int | None = None
    voltage: float | None = None
    temperature: float | None = None
    position: float | None = None
    errors: tuple[str, ...] = ()
    problem: str = ''
    remedy: str = ''

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problem


def permanent_settings(parameters: ServoBusParameters) -> list[tuple[Register, int]]:
    """Settings that the servo keeps without power, the mode first: it resets the gains."""
    amperes = round(parameters.current_limit / registers.CURRENT_UNIT)
    return [(registers.OPERATING_MODE, registers.MODE_CODES[parameters.mode]),
            (registers.DRIVE_MODE, 0), (registers.HOMING_OFFSET, 0),
            (registers.RETURN_DELAY, 0), (registers.CURRENT_LIMIT, amperes)]


def volatile_settings(parameters: ServoBusParameters) -> list[tuple[Register, int]]:
    """Settings that a restart of the servo loses; torque and watchdog come later."""
    gains = parameters.gains
    settings = [MARK, (registers.STATUS_LEVEL, 2),
                (registers.POSITION_P, gains.proportional),
                (registers.POSITION_I, gains.integral),
                (registers.POSITION_D, gains.derivative),
                (registers.FEEDFORWARD_1, gains.feedforward_velocity),
                (registers.FEEDFORWARD_2, gains.feedforward_acceleration),
                (registers.PROFILE_ACCELERATION, 0), (registers.PROFILE_VELOCITY, 0)]
    if parameters.mode == 'current_based_position':
        amperes = round(parameters.current_limit / registers.CURRENT_UNIT)
        settings.append((registers.GOAL_CURRENT, amperes))
    return settings


def watchdog_counts(parameters: ServoBusParameters) -> int:
    """Bus Watchdog (98) for the wanted time."""
    return max(1, min(127, round(parameters.timing.watchdog / registers.WATCHDOG_UNIT)))


def is_marked(link: ServoLink, identifier: int) -> bool:
    """Tell whether a servo still runs as it was configured: then it has counted every turn."""
    register, value = MARK
    return retried(link.read, identifier, register) == value


def examine(link: ServoLink, servo) -> ServoFinding:
    """Look at one servo without changing it."""
    place = {'name': servo.name, 'identifier': servo.identifier}
    try:
        model = retried(link.ping, servo.identifier)
    except NoAnswer:
        return ServoFinding(**place, problem='does not answer',
                            remedy='check power, cable and id; is another baud rate set?')
    except Refused as error:
        return ServoFinding(**place, problem=str(error), remedy='reboot it')
    wanted = (registers.FIRMWARE, registers.INPUT_VOLTAGE, registers.TEMPERATURE,
              registers.HARDWARE_ERROR, registers.PRESENT_POSITION, registers.SHADOW_ID)
    try:
        firmware, voltage, temperature, error, position, shadow = (
            retried(link.read, servo.identifier, register) for register in wanted)
    except ServoBusError as error:
        return ServoFinding(**place, model=model, problem=str(error),
                            remedy='check its cable; more than one servo with this id?')
    place |= {'model': model, 'firmware': firmware, 'baud_rate': link.baud_rate,
              'voltage': voltage * registers.VOLTAGE_UNIT, 'temperature': float(temperature),
              'position': servo.angle(position), 'errors': registers.hardware_errors(error)}
    if model != registers.MODEL:
        return ServoFinding(**place, problem=f'model {model}, expected {registers.MODEL} '
                            '(XC330-T181-T)', remedy='another servo has this id, or ids is wrong')
    if error:
        return ServoFinding(**place, problem=', '.join(registers.hardware_errors(error)),
                            remedy='remove the cause, then reboot the servo')
    if shadow <= 252:
        return ServoFinding(**place, problem=f'also listens to id {shadow}',
                            remedy='set Secondary(Shadow) ID(12) to 255')
    return ServoFinding(**place)


def configure(link: ServoLink, parameters: ServoBusParameters, servos) -> bool:
    """
    Take the torque off and make every setting ours; EEPROM is written only where it differs.

    Returns:
        whether all can do fast sync read.

    Raises:
        ServoBusError: one line for all servos that are missing, wrong or refuse.

    """
    problems, firmware = [], []
    for servo in servos:
        finding = examine(link, servo)
        if not finding.ok:
            problems.append(f'{servo.name} (id {servo.identifier}): {finding.problem}; '
                            f'{finding.remedy}')
            continue
        firmware.append(finding.firmware)
        try:
            servo.turns_known &= is_marked(link, servo.identifier)
            _apply(link, parameters, servo.identifier, finding.firmware)
        except ServoBusError as error:
            problems.append(f'{servo.name}: {error}')
    if problems:
        raise ServoBusError(f'{link.where()}: ' + ' | '.join(problems))
    return all(number >= registers.FIRST_FAST_FIRMWARE for number in firmware)


def _apply(link, parameters, identifier, firmware):
    link.write(identifier, registers.WATCHDOG, 0)
    link.write(identifier, registers.TORQUE_ENABLE, 0)
    settings = permanent_settings(parameters)
    if firmware >= registers.FIRST_FAST_FIRMWARE:
        settings.append((registers.STARTUP, 0))  # no torque, nothing restored after power-up
    for register, value in settings:
        if retried(link.read, identifier, register) != value:
            link.write(identifier, register, value)
    for register, value in settings + volatile_settings(parameters):
        if not register.permanent:
            link.write(identifier, register, value)
        found = retried(link.read, identifier, register)
        if found != value:
            raise ServoBusError(f'{link.where(identifier)}: {register.name}({register.address}) '
                                f'is {found} after {value} was written')


def locate(link: ServoLink, parameters: ServoBusParameters, servos):
    """Read where the servos are; restarted ones get their settings and lose their turns."""
    for servo in servos:
        if not is_marked(link, servo.identifier):
            servo.turns_known = False
            for register, value in volatile_settings(parameters):
                link.write(servo.identifier, register, value)
        counts = retried(link.read, servo.identifier, registers.PRESENT_POSITION)
        servo.turns *= servo.turns_known
        servo.position = servo.angle(counts) + TURN * servo.turns


def power(link: ServoLink, parameters: ServoBusParameters, servo):
    """Give a servo torque at its place; its watchdog runs from then on."""
    for register, value in ((registers.WATCHDOG, 0),
                            (registers.GOAL_POSITION, servo.counts(servo.position)),
                            (registers.WATCHDOG, watchdog_counts(parameters)),
                            (registers.TORQUE_ENABLE, 1)):
        link.write(servo.identifier, register, value)
    servo.torque, servo.watchdog_expired = True, False


def scan(parameters: ServoBusParameters,
         others: Iterable[int] = (1,)) -> list[tuple[int, int, int]]:
    """
    Look for servos at every baud rate that the port can do.

    Args:
        parameters: of the bus; its ids are looked for.
        others: further ids; by default a new servo's.

    Returns:
        (baud rate, ID, model) of each that answers.

    Raises:
        PortLost: the port cannot be opened.

    """
    found, failure, opened = [], None, False
    for baud_rate in registers.BAUD_CODES:
        link = ServoLink(parameters.port, baud_rate, max(parameters.timing.reply, 0.005))
        try:
            link.open()
        except PortLost as error:
            failure = error     # not every adapter can do every rate
            continue
        opened = True
        try:
            for identifier in sorted({*others, *(int(name) for name in parameters.ids)}):
                try:
                    found.append((baud_rate, identifier, link.ping(identifier)))
                except ServoBusError:
                    continue
        finally:
            link.close()
    if not opened:
        raise failure
    return found


def retried(call, *arguments, attempts: int = 3):
    """Repeat a read whose answer went missing."""
    for attempt in range(attempts):
        try:
            return call(*arguments)
        except NoAnswer:
            if attempt == attempts - 1:
                raise
