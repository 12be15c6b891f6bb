"""
Conversion between thrust and PWM duty of a rotor at any pack voltage.

The robot file gives the duty as a cubic in thrust at a few voltages. Between two voltages the
duty is interpolated at equal fractions of the largest thrust, because all measurements end at the
same duty. No cubic is therefore used beyond its measured thrusts.
"""

import numpy as np

from beetle_omni_ros.model.parts import RotorParameters
from beetle_omni_ros.model.schema import ParameterError

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
        """As :meth:`thrust_limit` [N], but extrapolated below the lowest row, at least zero."""
        (v, w), (f, g) = self.voltages[:2], self.thrust_limits[:2]
        low = f + (voltage - v) * (g - f) / (w - v)
        return np.maximum(0.0, np.where(voltage < v, low, np.interp(
            voltage, self.voltages, self.thrust_limits)))

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
