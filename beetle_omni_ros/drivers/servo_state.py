"""State of each servo, feedback and health."""

from dataclasses import dataclass
import struct

import numpy as np

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_turns import nearest_turns, TURN
from beetle_omni_ros.robot.parameters import JOINT_NAMES

# Current, velocity and position have consecutive addresses.
FEEDBACK = registers.PRESENT_CURRENT.address
FEEDBACK_SIZE = 10
_FEEDBACK = struct.Struct('<hii')
TRACKED = 0.2   # [s] half a turn takes longer at the servo's largest speed, 12 rad/s


@dataclass(frozen=True, slots=True)
class ServoReadings:
    """
    Feedback of the four servos.

    Attributes:
        stamp: time of the request on the bus's clock [s].
        position: (4,) tilt [rad], unwrapped; the last reading if not valid, NaN before the first.
        velocity: (4,) [rad/s].
        current: (4,) [A], with the sign of the tilt.
        effort: (4,) torque estimated from the current [N m].
        valid: (4,) bool: whether a servo was read in this call.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    current: np.ndarray
    effort: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, slots=True)
class ServoHealth:
    """
    Last known health of one servo.

    Attributes:
        name: name of the joint.
        identifier: ID on the bus.
        responding: whether it answers.
        torque: whether its motor is powered; None if unknown.
        errors: hardware errors in words.
        watchdog_expired: whether the bus watchdog has stopped it.
        recovering: whether its recovery is running.
        voltage: input voltage [V], NaN if unknown.
        temperature: [deg C], NaN if unknown.
        message: problem and remedy; '' without a problem.

    """

    name: str
    identifier: int
    responding: bool
    torque: bool | None
    errors: tuple[str, ...]
    watchdog_expired: bool
    recovering: bool
    voltage: float
    temperature: float
    message: str


@dataclass(slots=True)
class Servo:
    """
    State of one servo in the driver.

    Attributes:
        turns: turns to add to its reading.
        turns_known: whether ``turns`` is certain.
        misses: consecutive missing answers.
        next_probe: time of the next ping while it is silent [s].
        kept_off: whether it has shut down and stays off until it is rebooted.
        updated: time of the last feedback [s].

    """

    name: str
    identifier: int
    sign: int
    zero: int
    position: float = float('nan')
    velocity: float = 0.0
    current: float = 0.0
    turns: int = 0
    turns_known: bool = False
    misses: int = 0
    silent: bool = False
    next_probe: float = 0.0
    probe_wait: float = 0.0
    torque: bool | None = None
    error: int = 0
    watchdog_expired: bool = False
    voltage: float = float('nan')
    temperature: float = float('nan')
    recoveries: int = 0
    kept_off: bool = False
    updated: float = float('-inf')

    def angle(self, counts: int) -> float:
        """Tilt of a reading without added turns [rad]."""
        return self.sign * (counts - self.zero) * registers.POSITION_UNIT

    def counts(self, tilt: float) -> int:
        """Goal for a tilt [rad], in the servo's present frame."""
        return round(self.zero + self.sign * (tilt - TURN * self.turns) / registers.POSITION_UNIT)

    def update(self, data: bytes, now: float, powered: bool) -> bool:
        """
        Update position, velocity and current from feedback.

        Args:
            data: ten bytes of the feedback registers.
            now: monotonic time [s].
            powered: whether it has torque, so that it cannot be turned by hand.

        Returns:
            whether the turn count jumped because the servo has restarted.

        """
        current, velocity, counts = _FEEDBACK.unpack(data)
        self.current = self.sign * current * registers.CURRENT_UNIT
        self.velocity = self.sign * velocity * registers.VELOCITY_UNIT
        angle = self.angle(counts)
        jumped = False
        if powered or now - self.updated < TRACKED:
            # A servo cannot move by half a turn between two readings. After a pause without
            # torque the servo's own count is used.
            turns = nearest_turns(angle, self.position)
            jumped = turns != self.turns
            self.turns = turns
        self.position = angle + TURN * self.turns
        self.updated, self.misses = now, 0
        return jumped

    def describe(self, recovering: bool, enabled: bool, where: str) -> ServoHealth:
        """Health of the servo, for diagnostics."""
        errors = registers.hardware_errors(self.error)
        message = ''
        if self.silent:
            message = f'{where}: silent; check its cable and power'
        elif errors and not self.torque:
            message = f'{where}: shut down ({", ".join(errors)}); remove the cause, reboot it'
        elif errors:
            message = f'{where}: {", ".join(errors)}'
        elif self.watchdog_expired:
            message = f'{where}: stopped by its watchdog'
        elif enabled and self.torque is False:
            message = f'{where}: torque is off'
        return ServoHealth(self.name, self.identifier, not self.silent, self.torque, errors,
                           self.watchdog_expired, recovering, self.voltage, self.temperature,
                           message)


def readings(servos: list[Servo], stamp: float, answered: set[int],
             torque_per_current: float) -> ServoReadings:
    """Last feedback of the servos; ``answered`` are the IDs of valid ones."""
    current = np.array([servo.current for servo in servos])
    return ServoReadings(
        stamp, np.array([servo.position for servo in servos]),
        np.array([servo.velocity for servo in servos]), current, current * torque_per_current,
        np.array([servo.identifier in answered for servo in servos]))


def make_servos(parameters) -> list[Servo]:
    """Initial state of the servo of each joint."""
    return [Servo(name, int(identifier), int(sign), int(zero)) for name, identifier, sign, zero
            in zip(JOINT_NAMES, parameters.ids, parameters.signs, parameters.zeros, strict=True)]
