"""Search, examination and configuration of servos."""

from collections.abc import Iterable
from dataclasses import dataclass

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_link import NoAnswer, Refused, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_registers import Register
from beetle_omni_ros.drivers.servo_turns import TURN

# A value that only a configured servo has: a restart sets the register to its default, 1200. The
# register has an effect only in velocity mode.
MARK = (registers.VELOCITY_I, 1201)


@dataclass(frozen=True, slots=True)
class ServoFinding:
    """
    State of one servo; None for values that could not be read.

    Attributes:
        problem: problem that prevents its use, or ''.
        remedy: remedy of the problem, or ''.

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
        """Whether there is no problem."""
        return not self.problem


def permanent_settings(parameters: ServoBusParameters) -> list[tuple[Register, int]]:
    """EEPROM settings; the mode is first, because it resets the gains."""
    amperes = round(parameters.current_limit / registers.CURRENT_UNIT)
    return [(registers.OPERATING_MODE, registers.MODE_CODES[parameters.mode]),
            (registers.DRIVE_MODE, 0), (registers.HOMING_OFFSET, 0),
            (registers.RETURN_DELAY, 0), (registers.CURRENT_LIMIT, amperes)]


def volatile_settings(parameters: ServoBusParameters) -> list[tuple[Register, int]]:
    """RAM settings, lost by a restart, except torque and watchdog."""
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
    """Value of Bus Watchdog (98) for the watchdog time in the parameters."""
    return max(1, min(127, round(parameters.timing.watchdog / registers.WATCHDOG_UNIT)))


def is_marked(link: ServoLink, identifier: int) -> bool:
    """Whether a servo has not restarted since it was configured, so that its turns are valid."""
    register, value = MARK
    return retried(link.read, identifier, register) == value


def examine(link: ServoLink, servo) -> ServoFinding:
    """Read the state of one servo without changing it."""
    place = {'name': servo.name, 'identifier': servo.identifier}
    try:
        model = retried(link.ping, servo.identifier)
    except NoAnswer:
        return ServoFinding(**place, problem='does not answer',
                            remedy='check power, cable, id and baud rate')
    except Refused as error:
        return ServoFinding(**place, problem=str(error), remedy='reboot it')
    wanted = (registers.FIRMWARE, registers.INPUT_VOLTAGE, registers.TEMPERATURE,
              registers.HARDWARE_ERROR, registers.PRESENT_POSITION, registers.SHADOW_ID)
    try:
        firmware, voltage, temperature, error, position, shadow = (
            retried(link.read, servo.identifier, register) for register in wanted)
    except ServoBusError as error:
        return ServoFinding(**place, model=model, problem=str(error),
                            remedy='check its cable, and whether two servos have this id')
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
        return ServoFinding(**place, problem=f'also has the secondary id {shadow}',
                            remedy='set Secondary(Shadow) ID(12) to 255')
    return ServoFinding(**place)


def configure(link: ServoLink, parameters: ServoBusParameters, servos) -> bool:
    """
    Switch the torque off and write all settings, EEPROM only where it differs.

    Returns:
        whether all servos support fast sync read.

    Raises:
        ServoBusError: servos are missing or wrong, or refuse a setting; the message names all.

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
    """Read all positions; restarted servos get their RAM settings and have unknown turns."""
    for servo in servos:
        if not is_marked(link, servo.identifier):
            servo.turns_known = False
            for register, value in volatile_settings(parameters):
                link.write(servo.identifier, register, value)
        counts = retried(link.read, servo.identifier, registers.PRESENT_POSITION)
        servo.turns *= servo.turns_known
        servo.position = servo.angle(counts) + TURN * servo.turns


def enable_torque(link: ServoLink, parameters: ServoBusParameters, servo):
    """Switch the torque on with the present position as goal, and start the watchdog."""
    for register, value in ((registers.WATCHDOG, 0),
                            (registers.GOAL_POSITION, servo.counts(servo.position)),
                            (registers.WATCHDOG, watchdog_counts(parameters)),
                            (registers.TORQUE_ENABLE, 1)):
        link.write(servo.identifier, register, value)
    servo.torque, servo.watchdog_expired = True, False


def scan(parameters: ServoBusParameters,
         others: Iterable[int] = (1,)) -> list[tuple[int, int, int]]:
    """
    Search servos at every baud rate of the port.

    Args:
        parameters: parameters of the bus; its IDs are searched.
        others: further IDs to search; by default that of a new servo.

    Returns:
        (baud rate, ID, model) of each servo that answers.

    Raises:
        PortLost: the port cannot be opened.

    """
    found, failure, opened = [], None, False
    for baud_rate in registers.BAUD_CODES:
        link = ServoLink(parameters.port, baud_rate, max(parameters.timing.reply, 0.005))
        try:
            link.open()
        except PortLost as error:
            failure = error     # some adapters lack some baud rates
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
    """Call a read, and repeat it if there is no answer."""
    for attempt in range(attempts):
        try:
            return call(*arguments)
        except NoAnswer:
            if attempt == attempts - 1:
                raise
