"""Messages between the processes of an in-process flight, with faults and queues."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget, State, Target
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.faults import Fault, Schedule
from beetle_omni_ros.sim.readings import Frame

QUEUE = 10      # messages of a topic that wait for a process; older ones are dropped, as in ROS


class Processes:
    """
    Messages from and to estimator, controllers and supervisor, modified by faults of processes.

    Without a fault all messages pass unchanged.

    Attributes:
        clock_step: error of the flight computer's clock [s].

    """

    def __init__(self, tick: float, supervisor: Supervisor):
        """``tick``: time between two calls of :meth:`frame` [s]."""
        self._supervisor = supervisor
        self._schedule = Schedule(tick, np.random.SeedSequence(0))
        self._waiting: dict[str, deque] = {}
        self._reported: dict[str, str] = {}     # bridge -> last reported state
        self.clock_step = 0.0

    def set_faults(self, faults: Sequence[Fault], now: float) -> None:
        """Set the faults of processes; their ``at`` counts from ``now`` [s]."""
        self._schedule.set(faults, now)

    @property
    def faults(self) -> list[str]:
        """Kinds of the active faults."""
        return self._schedule.names

    def frame(self, frame: Frame) -> Frame:
        """Start a tick; returns the frame with stamps of the flight computer's clock."""
        if self._schedule.empty:
            return frame
        self._schedule.update(frame.time)
        self.clock_step = sum(self._schedule.each('clock'))
        if not self.supervisor_waits:
            self._deliver_queued()
        if not self.clock_step:
            return frame
        shifted = {name: replace(reading, stamp=reading.stamp + self.clock_step)
                   for name in ('imu', 'mocap', 'joints', 'rotors', 'battery')
                   if (reading := getattr(frame, name)) is not None}
        return replace(frame, time=frame.time + self.clock_step, **shifted)

    @property
    def supervisor_waits(self) -> bool:
        """Whether the supervisor is not scheduled at present."""
        return bool(self._schedule.each('waits'))

    def send(self, method: str, *message) -> None:
        """Call one of the supervisor's ``on_`` methods, or queue the message."""
        if not self._schedule.empty and self.supervisor_waits:
            self._waiting.setdefault(method, deque(maxlen=QUEUE)).append(message)
        else:
            getattr(self._supervisor, method)(*message)

    def _deliver_queued(self):
        for method, messages in self._waiting.items():
            for message in messages:
                getattr(self._supervisor, method)(*message)
        self._waiting = {}

    def estimate(self, state: State) -> State | None:
        """Estimate after the faults; None if it is not sent."""
        return next(iter(self._schedule.through('estimate', state, 0.0)), None)

    def requests(self, command: Command | None, now: float) -> list[Command]:
        """Commands of the active controller that arrive now; None: delayed ones only."""
        return self._schedule.through('request', command, now)

    def target(self, target: Target) -> PoseTarget | None:
        """Target of a fault while ``target`` is in force, or None."""
        for pose in self._schedule.each('target'):
            return PoseTarget(*pose, stamp=target.stamp)
        return None

    @property
    def bridges(self) -> dict[str, str]:
        """Bridge -> its reported state, if that has changed."""
        if self._schedule.empty:
            return {}
        states = {name: text for bridges in self._schedule.each('bridges')
                  for name, text in bridges.items()}
        new = {name: text for name, text in states.items() if self._reported.get(name) != text}
        self._reported.update(new)
        return new
