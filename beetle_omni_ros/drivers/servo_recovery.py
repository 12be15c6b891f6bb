"""
Recovery of a servo while the others continue, with one transaction in each step.

A restarted servo has lost gains, watchdog, torque and turn count. :func:`recovery` is a generator,
which the bus advances by one step in a tick, so that no tick is late.
"""

from collections.abc import Callable, Iterator

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_link import NoAnswer, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_setup import volatile_settings, watchdog_counts
from beetle_omni_ros.drivers.servo_state import Servo
from beetle_omni_ros.drivers.servo_turns import nearest_turns

FIRST_PING = 0.2    # [s] after a reboot; a servo does not answer earlier
PING_PERIOD = 0.02  # [s]


def recovery(link: ServoLink, parameters: ServoBusParameters, servo: Servo, enabled: bool,
             forced: bool, clock: Callable[[], float], log: Callable[[str], None]
             ) -> Iterator[None]:
    """
    Read the state of a servo and recover it, updating ``servo``.

    At the end it has torque if ``enabled``. With ``forced`` it is restarted in any case. ``clock``
    is monotonic [s], and ``log`` adds a line to the log.

    Yields:
        after each transaction, and while waiting.

    Raises:
        ServoBusError, PortLost: the recovery failed; another one may be started.

    """
    where = f'{servo.name} ({link.where(servo.identifier)})'
    servo.error = link.read(servo.identifier, registers.HARDWARE_ERROR)
    yield
    servo.torque = bool(link.read(servo.identifier, registers.TORQUE_ENABLE))
    yield
    if servo.torque and not forced:
        return
    if (servo.error and not servo.torque) or forced:
        if not forced and not _may_restart(parameters, servo, enabled):
            causes = ', '.join(registers.hardware_errors(servo.error))
            log(f'{where}: shut down ({causes}); it stays off until it is rebooted')
            servo.kept_off = True
            return
        servo.recoveries += 1
        servo.kept_off = False
        log(f'{where}: restarting it')
        link.reboot(servo.identifier)
        servo.silent = True  # so that reads of the others do not wait for it
        yield from _boot(link, parameters, servo, clock)
        servo.error = link.read(servo.identifier, registers.HARDWARE_ERROR)
        yield
    for register, value in volatile_settings(parameters):
        link.write(servo.identifier, register, value, attempts=1)
        yield
    counts = link.read(servo.identifier, registers.PRESENT_POSITION)
    angle = servo.angle(counts)
    if servo.position == servo.position:
        servo.turns = nearest_turns(angle, servo.position)
    yield
    servo.torque = False
    if not enabled:
        servo.turns_known = False
        log(f'{where}: is back, without torque')
        return
    # The goals of the running loop also use the new turn count.
    link.write(servo.identifier, registers.GOAL_POSITION, counts, attempts=1)
    yield
    link.write(servo.identifier, registers.WATCHDOG, watchdog_counts(parameters), attempts=1)
    yield
    link.write(servo.identifier, registers.TORQUE_ENABLE, 1, attempts=1)
    servo.torque = True
    servo.watchdog_expired = False
    log(f'{where}: had restarted, is back at {servo.position:+.2f} rad')


def _may_restart(parameters, servo, enabled):
    return (enabled and parameters.reboot_after_overload
            and not servo.error & registers.OVERHEATING
            and servo.recoveries < parameters.recoveries)


def _boot(link, parameters, servo, clock):
    """Wait until the servo answers again."""
    start = last = clock()
    while clock() - start < FIRST_PING:
        yield
    while True:
        if clock() - last >= PING_PERIOD:
            last = clock()
            try:
                link.ping(servo.identifier)
                servo.silent, servo.misses = False, 0
                return
            except NoAnswer:
                if clock() - start > parameters.timing.reboot:
                    raise
        yield
