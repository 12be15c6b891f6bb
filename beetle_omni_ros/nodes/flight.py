"""The course of one flight: start, arm, take off, watch, land."""

from __future__ import annotations

import sys
import time

from rich.progress import Progress

from beetle_omni_ros.nodes.actuators import BridgeCounts, BRIDGES
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.runs.tasks import Task

READY_TIMEOUT = 300.0   # s; the first start compiles the controller
BRIDGES_TIMEOUT = 20.0  # s; their devices are there as soon as the simulator is
ARM_TIMEOUT = 10.0      # s
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which all processes come to rest
LANDING_TIMEOUT = 30.0  # s
SPARE_TIME = 10.0       # s beyond the task's duration before a flight counts as stuck
LOOK_PERIOD = 0.1       # s between looks at processes and progress


class FlightError(RuntimeError):
    """The flight did not go as asked; the text is one line for the operator."""


class Flight:
    """
    One flight of a running graph.

    Args:
        graph: not yet started or just so.
        operator: in the same domain.
        task: what to fly.
        bars: where to show how it goes.

    Attributes:
        measured: CPU of the graph and of its bridges [% of one core], latencies [ms], cycles of
            the bridges.

    """

    def __init__(self, graph: Graph, operator: Operator, task: Task, bars: Progress):
        """Prepare the bar."""
        self._graph, self._operator, self._task = graph, operator, task
        self._bridges = [node for node in graph.nodes if node in BRIDGES]
        self._bars = bars
        self._bar = bars.add_task('', total=task.duration, at='')
        self._reported: set[str] = set()
        self.measured: dict[str, float] = {}

    def fly(self) -> None:
        """
        Get ready, take off and fly the task to its end.

        Raises:
            FlightError: naming what went wrong.

        """
        operator = self._operator
        self._await('starting (the first time compiles the controller)',
                    lambda: operator.ready and operator.progress, READY_TIMEOUT)
        self._await('actuators', lambda: not operator.waits_for(self._bridges), BRIDGES_TIMEOUT)
        self._take_off()
        counts = BridgeCounts(operator.values)
        cpu, bridges_cpu = self._graph.cpu_seconds(), self._graph.cpu_seconds(bridges=True)
        start = time.monotonic()
        while not operator.progress.startswith('done'):
            self._look()
            flown = time.monotonic() - start
            self._say(f'{self._task.name} ({operator.state})', operator.progress, flown)
            self._measure('cpu_percent', self._graph.cpu_seconds() - cpu, start)
            if self._bridges:
                self._measure('bridges_cpu_percent',
                              self._graph.cpu_seconds(bridges=True) - bridges_cpu, start)
            if operator.state in ('disarmed', 'emergency_stop'):
                raise FlightError(f"the flight ended early, supervisor in '{operator.state}'")
            if flown > self._task.duration + SPARE_TIME:
                raise FlightError(f"the task hangs at '{operator.progress}'")
        status, prefix = ('rotor_bridge_node', 'age_') if self._bridges else ('sim_node', '')
        for name in ('median_ms', 'p99_ms', 'max_ms'):
            value = operator.values(f'{status}: latency').get(prefix + name)
            if value is not None:
                self.measured[f'latency_{name}'] = float(value)
        self.measured.update(counts.measured())

    def _measure(self, key, seconds, start):
        self.measured[key] = 100 * seconds / (time.monotonic() - start)

    def _take_off(self):
        """Arm and climb; a start that the busy computer spoilt on the ground is tried again."""
        operator = self._operator
        for _ in range(TAKEOFF_ATTEMPTS):
            self._say('arming')
            deadline = time.monotonic() + ARM_TIMEOUT
            self._look(SETTLE_TIME)
            while not (answer := operator.call('arm'))[0]:
                if time.monotonic() > deadline:
                    raise FlightError(f'supervisor_node refuses to arm: {answer[1]}')
                self._look()
            operator.states.clear()
            self._await('taking off', lambda: operator.state.startswith('flying')
                        or 'disarmed' in operator.states, TAKEOFF_TIMEOUT)
            if operator.state.startswith('flying'):
                return
        raise FlightError(f'no take-off in {TAKEOFF_ATTEMPTS} attempts; see the warnings below')

    def land(self) -> None:
        """Land, if there is a supervisor that can; wait for the motors to stop."""
        operator = self._operator
        if operator.state in ('', 'disarmed', 'emergency_stop'):
            return
        self._say('landing')
        accepted, answer = operator.call('land')
        if not accepted:
            print(f'beetle_omni fly: error: no landing: {answer}', file=sys.stderr)
        else:
            operator.wait(lambda: operator.state in ('disarmed', 'emergency_stop'),
                          LANDING_TIMEOUT)
            operator.spin(1.1)      # the last diagnostics

    def _await(self, text, condition, timeout):
        self._say(text)
        deadline = time.monotonic() + timeout
        while not condition():
            self._look()
            if time.monotonic() > deadline:
                waits = self._operator.waits_for(self._bridges)
                raise FlightError(f'{text}: nothing after {timeout:g} s, supervisor in '
                                  f"'{self._operator.state}'" + (waits and f'; {waits}'))

    def _look(self, seconds=LOOK_PERIOD):
        """Take in messages; a dead process ends the flight."""
        self._operator.spin(seconds)
        dead = {name: how for name, how in self._graph.dead().items()
                if name not in self._reported}
        self._reported |= set(dead)
        if dead:
            raise FlightError('; '.join(f'{name} died ({how})' for name, how in dead.items()))

    def _say(self, text, at='', completed=0.0):
        self._bars.update(self._bar, description=text, at=at,
                          completed=min(completed, self._task.duration))
