"""Thrust from commands: dead time, cut, lag; and the pack that feeds the rotors."""

from collections import deque
from math import exp, log1p, pi, sqrt

import numpy as np

from gap_data.hidden import Hidden
from gap_data.truth import Robot


class DelayLine:
    """Commands that take hold some time after their stamp; held until the next."""

    def __init__(self, delay: float, first: list[float]):
        self.delay = delay
        self.now = list(first)
        self._waiting: deque = deque()

    def send(self, stamp: float, values) -> None:
        """Queue values (4,) that take hold at ``stamp`` + delay [s]."""
        self._waiting.append((stamp + self.delay, list(values)))

    def at(self, t: float) -> list[float]:
        """What is in force at ``t`` [s]; ask in order of time."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= t + 1e-9:
            self.now = waiting.popleft()[1]
        return self.now


class Rotors:
    """First-order lags, exact between two steps for held commands."""

    def __init__(self, robot: Robot, hidden: Hidden, step: float, thrust):
        self.thrust = [float(f) for f in thrust]
        self.rate = [0.0] * 4
        self._inner = list(self.thrust)
        self._ceiling, self._soft = hidden.thrust_ceiling, hidden.ceiling_softness
        self._most = robot.thrust_max
        times = [float(T) for T in robot.time_constant]
        share, skew = hidden.rotor_poles, hidden.lag_asymmetry
        self._fast = [exp(-step / (share * T)) if share > 0 else 0.0 for T in times]
        self._up = [exp(-step / ((1 - share) * (1 - skew) * T)) for T in times]
        self._down = [exp(-step / ((1 - share) * (1 + skew) * T)) for T in times]
        self._step = step

    def advance(self, commands: list[float]) -> list[float]:
        """One step under held commands (4,) [N]; the thrusts at its middle."""
        middle = []
        for i in range(4):
            wanted = self._cut(commands[i])
            inner = wanted + (self._inner[i] - wanted) * self._fast[i]
            self._inner[i] = inner
            before = self.thrust[i]
            after = inner + (before - inner) * (self._up[i] if inner > before else self._down[i])
            self.thrust[i] = after
            self.rate[i] = (after - before) / self._step
            middle.append(0.5 * (before + after))
        return middle

    def _cut(self, wanted):
        wanted = min(max(wanted, 0.0), self._most)
        if self._ceiling is None:
            return wanted
        if self._soft <= 0:
            return min(wanted, self._ceiling)
        gap = (wanted - self._ceiling) / self._soft
        bend = gap + log1p(exp(-gap)) if gap > 0 else log1p(exp(gap))
        return wanted - self._soft * bend


class Pack:
    """Lithium-polymer pack: rest voltage falls with charge, and the load sags it."""

    def __init__(self, robot: Robot, charge: float):
        numbers = robot.numbers
        battery, self._full = numbers['battery'], numbers['robot']['full_voltage']
        self._resistance = numbers['robot']['pack_resistance']
        self._levels, self._volts = battery['levels'], battery['relative_voltage']
        self._capacity = battery['capacity'] * 3600
        disc = pi * numbers['robot']['propeller_radius'] ** 2
        self._power = 1 / (sqrt(2 * battery['air_density'] * disc) * battery['figure_of_merit'])
        self._idle = battery['idle_power']
        self.charge = charge
        self.rest = self._rest()
        self.voltage, self.current = self.rest, 0.0

    def _rest(self):
        return self._full * float(np.interp(self.charge, self._levels, self._volts))

    def load(self, thrusts: list[float], duration: float, refresh: bool) -> float:
        """Draw the rotors' power for a time [s]; the terminal voltage [V]."""
        power = self._idle + self._power * sum(f * sqrt(f) for f in thrusts if f > 0)
        if refresh:
            self.rest = self._rest()
        half = 0.5 * self.rest
        self.voltage = half + sqrt(max(half * half - power * self._resistance, 0.0))
        self.current = power / self.voltage
        self.charge = max(0.0, self.charge - self.current * duration / self._capacity)
        return self.voltage
