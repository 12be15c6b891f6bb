"""Faults of the processes of the flight stack: their messages, clock and schedule."""

from typing import Any

import numpy as np

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.sim.faults import Schedule


class ProcessFaults(Schedule):
    """
    Faults of estimator, controllers, supervisor and bridges, updated in each tick.

    Attributes:
        clock_step: error of the flight computer's clock [s].
        supervisor_waits: whether the supervisor is not scheduled.

    """

    def __init__(self, tick: float):
        """``tick``: time between two updates [s]."""
        super().__init__(tick, np.random.SeedSequence(0))
        self.clock_step, self.supervisor_waits = 0.0, False
        self._bridges: dict[str, str] = {}      # bridge -> last reported state
        self._aimed = False     # whether the other target of a fault was published

    def update(self, now: float, truth: Any = None, held: np.ndarray | None = None) -> None:
        """Start and end the faults due at ``now`` [s]."""
        super().update(now, truth, held)
        self.clock_step = sum(self.each('clock'))
        self.supervisor_waits = bool(self.each('waits'))

    def passed(self, topic: str, value: Any, active: str, now: float) -> list:
        """Values that arrive ``now`` [s] on a topic; ``active`` is the active controller."""
        signal = {'odom': 'estimate', f'{active}/command': 'request'}.get(topic)
        return [value] if signal is None else self.through(signal, value, now)

    def messages(self, active: str, now: float) -> list[tuple[str, Any]]:
        """Messages (topic, value) that the faults cause by themselves in this tick."""
        caused: list[tuple[str, Any]] = [
            (f'{active}/command', late) for late in self.through('request', None, now)]
        for bridges in self.each('bridges'):
            for name, text in bridges.items():
                if self._bridges.get(name) != text:
                    self._bridges[name] = text
                    caused.append((f'{name}_bridge/state', text))
        targets = self.each('target')
        if targets and not self._aimed:
            caused.append(('target_pose', PoseTarget(*targets[0], stamp=now)))
        self._aimed = bool(targets)
        return caused
