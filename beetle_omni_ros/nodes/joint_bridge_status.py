"""Diagnostics of the servo bus and of each servo: level, text and values."""

from __future__ import annotations

import time

from beetle_omni_ros.nodes import health
from beetle_omni_ros.nodes.lifecycle_node import ACTIVE


def bus_status():
    """Make the source of the bus's status; it remembers what it has told."""
    told = {'cycles': 0, 'missed': 0, 'time': time.monotonic(), 'loop': None}

    def status(stage, text, bus, loop):
        if loop is None:
            return (health.WARN if stage == ACTIVE else health.OK), text, {'stage': stage}
        if loop is not told['loop']:
            told.update(cycles=0, missed=0, loop=loop)
        now = time.monotonic()
        link = bus.statistics
        values = {
            'stage': stage, 'cycles': loop.cycles, 'missed_cycles': loop.missed,
            'rate_hz': (loop.cycles - told['cycles']) / max(now - told['time'], 1e-3),
            'connected': bus.connected, 'goals_written': loop.written,
            'goals_stale': loop.stale, 'goals_clipped': bus.clipped,
            'incomplete': loop.incomplete, 'transactions': link.transactions,
            'unanswered': link.unanswered, 'corrupt': link.corrupt, 'refused': link.refused,
            'connections': link.connections}
        missed = loop.missed - told['missed']
        told.update(cycles=loop.cycles, missed=loop.missed, time=now)
        if text.startswith('lost'):
            return health.ERROR, text, values
        if not bus.connected or missed:
            return health.WARN, f'{missed} cycles missed' if bus.connected else 'no connection', \
                values
        return health.OK, text, values

    return status


def servo_status(loop, index):
    """Return level, text and values of one servo."""
    if loop is None:
        return health.OK, 'not configured', {}
    one = loop.health()[index]
    values = {'id': one.identifier, 'responding': one.responding,
              'torque': 'unknown' if one.torque is None else one.torque,
              'voltage_v': one.voltage, 'temperature_c': one.temperature,
              'errors': ', '.join(one.errors) or 'none',
              'watchdog_expired': one.watchdog_expired, 'recovering': one.recovering}
    if one.message:
        bad = not one.responding or (one.errors and not one.torque)
        return (health.ERROR if bad else health.WARN), one.message, values
    return health.OK, 'being brought back' if one.recovering else 'ok', values
