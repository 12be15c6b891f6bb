"""Parts of a robot in its file: rotors, tilt servos, battery, masses of the modules."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.model.schema import parameter, ParameterError


@dataclass(frozen=True, kw_only=True)
class RotorMapRow:
    """Thrust-to-PWM polynomial measured at one pack voltage."""

    voltage: float = parameter(doc='pack voltage under load', unit='V', low=5, high=60)
    thrust_max: float = parameter(doc='largest thrust measured', unit='N', low=0.1, high=200)
    coefficients: np.ndarray = parameter(
        doc='duty [%] = sum_k c_k (thrust / 10 N)^k, k = 0..3', shape=(4,))


@dataclass(frozen=True, kw_only=True)
class MotorMap:
    """Thrust of a brushed motor's rotor by its mean voltage, duty times pack voltage."""

    nominal_voltage: float = parameter(
        doc='pack voltage that a model without voltage assumes; the base of voltage_sag',
        unit='V', low=1, high=60)
    coefficients: np.ndarray = parameter(
        doc='thrust [N] = sum_k c_k (motor voltage / 1 V)^k, k = 0..3', shape=(4,))


@dataclass(frozen=True, kw_only=True)
class RotorParameters:
    """Positions of the four rotors and their thrust."""

    positions: np.ndarray = parameter(
        doc='rotor centres from the centre of gravity', unit='m', shape=(4, 3), low=-5, high=5)
    arm_yaw: np.ndarray = parameter(
        doc='direction of each arm in base_link', unit='rad', shape=(4,), low=-7, high=7)
    spin: np.ndarray = parameter(doc='spin direction, +1 or -1', shape=(4,), low=-1, high=1)
    torque_to_thrust_ratio: float = parameter(
        doc='reaction torque for each newton of thrust', unit='m', low=0, high=1)
    thrust_min: float = parameter(0.0, doc='smallest thrust', unit='N', low=0, high=50)
    thrust_max: float = parameter(doc='largest thrust', unit='N', low=0.1, high=200)
    time_constant: float = parameter(
        doc='first-order thrust response', unit='s', low=0.001, high=2)
    map: tuple[RotorMapRow, ...] = parameter(
        (), doc='thrust-to-PWM rows, one for each measured voltage')
    motor: MotorMap | None = parameter(
        None, doc='thrust by motor voltage, for recordings of duty and voltage')


@dataclass(frozen=True, kw_only=True)
class JointParameters:
    """
    The tilt servos: J q'' = Kp (q* - q) - Kd q', within limits.

    The effect ``joint_bandwidth`` may give each servo its own gains, (4,) arrays.
    """

    inertia: float = parameter(doc='effective inertia', unit='kg m^2', low=1e-7, high=1)
    kp: float = parameter(doc='stiffness', unit='N m/rad', low=1e-4, high=1e3)
    kd: float = parameter(doc='damping', unit='N m s/rad', low=0, high=1e2)
    velocity_limit: float = parameter(
        doc='largest rate without load', unit='rad/s', low=0.1, high=100)
    speed_gradient: float = parameter(
        0.0, doc='loss of the largest rate for each torque', unit='rad/(N m s)', low=0, high=1e4)
    effort_limit: float = parameter(doc='largest torque', unit='N m', low=0.01, high=100)
    position_limit: float = parameter(doc='travel to each side', unit='rad', low=0.1, high=100)

    def of(self, joint: int) -> JointParameters:
        """The servo of one joint (index)."""
        kp, kd = (float(np.broadcast_to(value, 4)[joint]) for value in (self.kp, self.kd))
        return replace(self, kp=kp, kd=kd)

    @property
    def natural_frequency(self) -> float:
        """Undamped natural frequency [rad/s], sqrt(Kp / J), of the mean servo."""
        return float(np.sqrt(np.mean(self.kp) / self.inertia))

    @property
    def damping_ratio(self) -> float:
        """Damping ratio [1], Kd / (2 sqrt(Kp J)), of the mean servo."""
        return float(np.mean(self.kd) / (2 * np.sqrt(np.mean(self.kp) * self.inertia)))

    @property
    def time_constant(self) -> float:
        """Time constant [s] of the first-order reduction: Kd / Kp, or sqrt(J / Kp) if larger."""
        return max(float(np.mean(self.kd) / np.mean(self.kp)), 1 / self.natural_frequency)


@dataclass(frozen=True, kw_only=True)
class BatteryParameters:
    """Battery pack."""

    cells: int = parameter(doc='cells in series', low=1, high=20)
    full_voltage: float = parameter(doc='open-circuit voltage when full', unit='V', low=3, high=90)
    resistance: float = parameter(doc='pack resistance', unit='ohm', low=0, high=2)


@dataclass(frozen=True, kw_only=True)
class ModuleParameters:
    """One tilting rotor module."""

    mass: float = parameter(doc='mass', unit='kg', low=0, high=20)
    joint_height: float = parameter(doc='z of the joint origin', unit='m', low=-5, high=5)
    centre_of_mass: np.ndarray = parameter(
        doc='outward, sideways, up from the joint axis', unit='m', shape=(3,))
    inertia: np.ndarray = parameter(doc='diagonal about its centre of mass', unit='kg m^2',
                                    shape=(3,), low=0)
    rotor_offset: float = parameter(doc='rotor centre, outward on the axis', unit='m', low=-5,
                                    high=5)


@dataclass(frozen=True, kw_only=True)
class EndEffectorParameters:
    """A ball on a stalk above the body."""

    mass: float = parameter(doc='mass', unit='kg', low=0, high=20)
    height: float = parameter(doc='height above the main body origin', unit='m', low=-5, high=5)


@dataclass(frozen=True, kw_only=True)
class MultibodyParameters:
    """Parts of the rigid body; the rest of the totals is the main body."""

    module: ModuleParameters = parameter(doc='tilting module')
    end_effector: EndEffectorParameters = parameter(doc='end-effector')

    @classmethod
    def from_totals(cls, module_inertia: float = 0.0,
                    mass_moment: float = 0.0) -> MultibodyParameters:
        """
        Parts of a robot that has only totals and perhaps the effect ``module_reaction``.

        Half of the inertia of a module about its joint axis [kg m^2] is assigned to its own
        inertia, half to its mass below the axis, which has this moment [kg m].
        """
        depth = 0.5 * module_inertia / mass_moment if mass_moment else 0.0
        own = module_inertia - mass_moment * depth
        return cls(module=ModuleParameters(
                       mass=mass_moment / depth if depth else 0.0, joint_height=0.0,
                       centre_of_mass=np.array([0.0, 0.0, -depth]), inertia=np.full(3, own),
                       rotor_offset=0.0),
                   end_effector=EndEffectorParameters(mass=0.0, height=0.0))


STOP_DUTY, FULL_DUTY = 50.0, 100.0  # [% of 2000 us] 1000 us and 2000 us
CELLS = 2048                        # linear pieces of a cubic; error at most 1e-5 of 0.5 N
FRACTIONS = np.linspace(0, 1, CELLS + 1)


class ThrustMap:
    """
    Measured map of one type of rotor.

    Thrust 0 stops the rotor. The duty of the smallest positive thrust is the map's at zero thrust.

    Attributes:
        voltages: (rows,) rising [V].
        thrust_limits: (rows,) largest measured thrust at each voltage [N].

    """

    def __init__(self, rotors: RotorParameters):
        """Tabulate the cubics of a robot file; a ParameterError refuses an impossible map."""
        rows = sorted(rotors.map, key=lambda row: row.voltage)
        self.voltages = np.array([row.voltage for row in rows])
        if not rows or np.any(np.diff(self.voltages) <= 0):
            raise ParameterError('rotors.map: expected one or more rows, each at another voltage, '
                                 f'found {self.voltages.tolist()} V')
        self.thrust_limits = np.array([row.thrust_max for row in rows])
        self._duty = np.empty((len(rows), CELLS + 1))
        for duty, row in zip(self._duty, rows):
            duty[:] = np.polynomial.polynomial.polyval(
                np.linspace(0, row.thrust_max, CELLS + 1) / 10, row.coefficients)
            if duty.min() < STOP_DUTY or duty.max() > FULL_DUTY or np.diff(duty).min() <= 0:
                raise ParameterError(
                    f'rotors.map at {row.voltage:g} V: duty {duty.min():.1f} to {duty.max():.1f} '
                    f'% over 0 to {row.thrust_max:g} N, expected a rise within {STOP_DUTY:g} to '
                    f'{FULL_DUTY:g} %')
        self._voltage, self._blend = np.nan, np.zeros(0)    # latest voltage, and its duties

    def thrust_limit(self, voltage):
        """Largest thrust [N] at ``voltage`` [V]; beyond the rows, that of the nearest row."""
        return np.interp(voltage, self.voltages, self.thrust_limits)

    def thrust_limit_below(self, voltage):
        """As :meth:`thrust_limit` [N], but extrapolated below the lowest of two or more rows."""
        known = self.thrust_limit(voltage)
        if len(self.voltages) < 2:
            return known
        (v, w), (f, g) = self.voltages[:2], self.thrust_limits[:2]
        low = f + (voltage - v) * (g - f) / (w - v)
        return np.maximum(0.0, np.where(voltage < v, low, known))

    def saturated(self, thrust, voltage) -> np.ndarray:
        """Whether ``thrust`` [N] exceeds the limit at ``voltage`` [V]; shapes broadcast."""
        return np.asarray(thrust) > self.thrust_limit(voltage)

    def duty(self, thrust, voltage: float) -> np.ndarray:
        """
        Duties [% of 2000 us] for thrusts [N] at one voltage [V].

        Thrust is limited to the largest at this voltage; zero or less stops the rotor.
        """
        share = np.asarray(thrust) / self.thrust_limit(voltage)
        return np.where(share > 0, np.interp(share, FRACTIONS, self._duties(voltage)), STOP_DUTY)

    def thrust(self, duty, voltage: float) -> np.ndarray:
        """
        Thrust [N] at duties [% of 2000 us] and one voltage [V], the exact inverse of :meth:`duty`.

        It is zero below the duty of zero thrust, and the limit above the largest measured duty.
        """
        return np.interp(duty, self._duties(voltage), FRACTIONS) * self.thrust_limit(voltage)

    def command(self, thrust, voltage) -> np.ndarray:
        """Normalised command, 0 (stop) to 1 (2000 us), for ``thrust`` [N] at ``voltage`` [V]."""
        return (self.duty(thrust, voltage) - STOP_DUTY) / (FULL_DUTY - STOP_DUTY)

    def _duties(self, voltage):
        """Duties (CELLS + 1,) at FRACTIONS of the largest thrust at a voltage."""
        if voltage != self._voltage:
            place = np.interp(voltage, self.voltages, np.arange(len(self.voltages)))
            low, high = int(place), int(np.ceil(place))
            self._voltage = voltage
            self._blend = (1 - place + low) * self._duty[low] + (place - low) * self._duty[high]
        return self._blend


def duty_of_command(command) -> np.ndarray:
    """Duty [% of 2000 us] of a normalised ``command``, 0 to 1."""
    return STOP_DUTY + (FULL_DUTY - STOP_DUTY) * np.asarray(command)
