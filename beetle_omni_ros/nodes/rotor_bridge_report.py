"""Diagnostics of rotor_bridge_node: the board with its link, the latency, each rotor."""

from __future__ import annotations

from functools import partial
import math

from beetle_omni_ros.drivers.motor_board_arming import Arming, FLIES, LOST
from beetle_omni_ros.drivers.motor_board_messages import BoardUpdate
from beetle_omni_ros.nodes import health
from beetle_omni_ros.nodes.target_stream import TargetStream


class RotorBridgeReport:
    """Gathers what the board tells and answers when diagnostics are due."""

    def __init__(self, reports: health.Health, arming: Arming, stream: TargetStream):
        """Add the statuses to the node's ``reports``."""
        self._arming, self._stream = arming, stream
        self._update: BoardUpdate | None = None
        self._battery = self._rotors = None
        self._saturated, self._missed = stream.saturated.copy(), 0
        reports.report('board', self._board_status)
        reports.report('latency', self._latency_status)
        for k in range(4):
            reports.report(f'rotor{k + 1}', partial(self._rotor_status, k))

    def update(self, update: BoardUpdate) -> None:
        """Take what is new."""
        self._update = update
        self._battery = update.battery or self._battery
        self._rotors = update.rotors or self._rotors

    def _board_status(self):
        arming, stream, text = self._arming, self._stream, self._arming.text
        values = {'phase': arming.phase, 'cycles': stream.cycles, 'missed_cycles': stream.missed}
        values.update((f'not sent: {reason}', n) for reason, n in stream.unsent.items())
        missed, self._missed = stream.missed - self._missed, stream.missed
        level = health.ERROR if arming.phase == LOST else \
            health.OK if text == 'ready' and not missed else health.WARN
        if missed and text == 'ready':
            text = f'{missed} cycles missed'
        update = self._update
        if update is None:
            return level, text, values
        if update.status is not None:
            status = update.status
            values.update({'armed': int(status.armed), 'state': status.state,
                           'last disarmed': status.stop_reason,
                           'conditions': ', '.join(status.conditions),
                           'contract': status.contract})
        if self._battery is not None:
            values.update({'voltage_V': self._battery.voltage, 'current_A': self._battery.current})
        return level, text, {**values, **_link(update)}

    def _latency_status(self):
        times, ages = self._stream.latency, self._stream.age
        return health.OK, f'from {self._stream.latency_from} to the last byte written', {
            'median_ms': 1e3 * times.quantile(0.5), 'p99_ms': 1e3 * times.quantile(0.99),
            'max_ms': 1e3 * times.max, 'count': times.count,
            'age_median_ms': 1e3 * ages.quantile(0.5), 'age_p99_ms': 1e3 * ages.quantile(0.99),
            'age_max_ms': 1e3 * ages.max}

    def _rotor_status(self, k):
        stream, rotors = self._stream, self._rotors
        values = {'saturated': int(stream.saturated[k]),
                  'command': float(stream.command[k]) if self._arming.phase == FLIES else 0.0}
        saturates = stream.saturated[k] > self._saturated[k]
        self._saturated[k] = stream.saturated[k]
        if rotors is None:
            return health.OK, 'nothing told yet', values
        faults = list(rotors.failures[k])
        if math.isnan(rotors.rpm[k]):
            faults.append('offline')
        values.update({
            'speed_rad_s': float(rotors.rpm[k]) * math.pi / 30,
            'voltage_V': float(rotors.voltage[k]), 'current_A': float(rotors.current[k]),
            'temperature_C': float(rotors.temperature[k]), 'failures': ', '.join(faults),
            'error_count': int(rotors.error_count[k])})
        if faults:
            return health.ERROR, ', '.join(faults), values
        if saturates:
            return health.WARN, 'asked for more thrust than the battery can give', values
        return health.OK, 'well', values


def _link(update):
    """Both directions of the link and the clocks, flat."""
    link, received = update.link, update.link.received
    values = {'received': received.messages, 'lost': received.lost, 'bad_crc': received.bad_crc,
              'skipped_bytes': received.skipped_bytes, 'sent': link.sent,
              'buffer_full': link.dropped, 'connections': link.connections}
    if link.board is not None:
        values.update({'board lost': link.board.lost, 'board bad_crc': link.board.bad_crc,
                       'board refused': link.board.refused,
                       'board timeouts': link.board.timeouts})
    values.update({'clock_offset_s': update.clock_offset,
                   'clock_uncertainty_ms': 1e3 * update.clock_uncertainty})
    return values
