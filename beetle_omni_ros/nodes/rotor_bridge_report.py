"""Diagnostics of rotor_bridge_node: targets, board and link, latency, rotors."""

from collections import Counter
from functools import partial
import math

import numpy as np

from beetle_omni_ros.drivers.motor_board import Arming, FLIES, LOST, MotorBoard, Sent
from beetle_omni_ros.nodes.node import Distribution, ERROR, Health, OK, WARN


class TargetStream:
    """
    Counts of a stream with one target every ``period`` [s].

    Attributes:
        cycles: periods in which a target was due.
        missed: periods without a target.
        unsent: reason -> number of targets that could not be sent.
        latency: time from the publication of a command to the last byte of its first target.
        latency_from: event from which the latency counts.
        age: time from a command's stamp to the last byte of its target: the latency of the whole
            loop from the IMU sample on.
        command: (4,) normalised commands of the newest target.
        saturated: (4,) number of targets of each rotor above the limit of the battery.

    """

    def __init__(self, period: float):
        self._period = period
        self._last: float | None = None
        self.cycles = self.missed = 0
        self.unsent: Counter = Counter()
        self.latency, self.latency_from = Distribution(), 'no command yet'
        self.age = Distribution()
        self.command = np.zeros(4)
        self.saturated = np.zeros(4, dtype=int)

    def rest(self) -> None:
        """Count no missed period before the next target."""
        self._last = None

    def add(self, sent: Sent, now: float) -> None:
        """Count the result of one target at monotonic time ``now`` [s]."""
        if sent.reason:
            self.unsent[sent.reason] += 1
            return
        if self._last is not None:
            # A gap nearer to one period than to two was in time.
            cycles = round((now - self._last) / self._period)
            self.cycles += cycles
            self.missed += max(cycles - 1, 0)
        self._last = now
        self.command = sent.command
        self.saturated += sent.saturated

    def answered(self, seconds: float, begin: str, age: float) -> None:
        """Add the latency [s] of one command since the event ``begin``, and its age [s]."""
        self.latency.add(seconds)
        self.latency_from = begin
        self.age.add(age)


class RotorBridgeReport:
    """Sources of the diagnostic statuses of the bridge."""

    def __init__(self, reports: Health, board: MotorBoard, arming: Arming,
                 stream: TargetStream):
        self._board, self._arming, self._stream = board, arming, stream
        self._battery = self._rotors = None
        self._saturated, self._missed = stream.saturated.copy(), 0
        reports.report('board', self._board_status)
        reports.report('latency', self._latency_status)
        for k in range(4):
            reports.report(f'rotor{k + 1}', partial(self._rotor_status, k))

    def update(self, battery, rotors) -> None:
        """Store the newest measurements of the board; None for no new one."""
        self._battery = battery or self._battery
        self._rotors = rotors or self._rotors

    def _board_status(self):
        arming, stream, text = self._arming, self._stream, self._arming.text
        values = {'phase': arming.phase, 'cycles': stream.cycles, 'missed_cycles': stream.missed}
        values.update((f'not sent: {reason}', n) for reason, n in stream.unsent.items())
        missed, self._missed = stream.missed - self._missed, stream.missed
        level = ERROR if arming.phase == LOST else \
            OK if text == 'ready' and not missed else WARN
        if missed and text == 'ready':
            text = f'{missed} cycles missed'
        if status := self._board.state.status:
            values.update({'armed': int(status.armed), 'state': status.state,
                           'last disarmed': status.stop_reason,
                           'conditions': ', '.join(status.conditions),
                           'contract': status.contract})
        if self._battery is not None:
            values.update({'voltage_V': self._battery.voltage, 'current_A': self._battery.current})
        return level, text, {**values, **self._board.link()}

    def _latency_status(self):
        times, ages = self._stream.latency, self._stream.age
        return OK, f'from {self._stream.latency_from} to the last byte written', {
            **times.milliseconds(), 'count': times.count, **ages.milliseconds('age_')}

    def _rotor_status(self, k):
        stream, rotors = self._stream, self._rotors
        values = {'saturated': int(stream.saturated[k]),
                  'command': float(stream.command[k]) if self._arming.phase == FLIES else 0.0}
        saturates = stream.saturated[k] > self._saturated[k]
        self._saturated[k] = stream.saturated[k]
        if rotors is None:
            return OK, 'no data yet', values
        faults = list(rotors.failures[k])
        if math.isnan(rotors.rpm[k]):
            faults.append('offline')
        values.update({
            'speed_rad_s': float(rotors.rpm[k]) * math.pi / 30,
            'voltage_V': float(rotors.voltage[k]), 'current_A': float(rotors.current[k]),
            'temperature_C': float(rotors.temperature[k]), 'failures': ', '.join(faults),
            'error_count': int(rotors.error_count[k])})
        if faults:
            return ERROR, ', '.join(faults), values
        if saturates:
            return WARN, 'target above the thrust that the battery permits', values
        return OK, 'ok', values
