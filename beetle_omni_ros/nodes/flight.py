"""The sequence of one flight: start, arm, take off, fly the task, land."""

from collections.abc import Callable
import sys
import time

from rich.progress import Progress

from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.health import ERROR
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.nodes.plan import BRIDGES
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.runs.tasks import Task

READY_TIMEOUT = 300.0   # s; the first start compiles the controller
BRIDGES_TIMEOUT = 20.0  # s; the simulator makes their devices at its start
ARM_TIMEOUT = 10.0      # s
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which start-up work ends
LANDING_TIMEOUT = 30.0  # s
SPARE_TIME = 10.0       # s beyond the task's duration before a flight counts as stuck
CHECK_PERIOD = 0.1      # s between checks of processes and progress
WATCH_TIME = 2.0        # s before arming in which the simulator is checked for real time
LOST_TIME = 0.2         # s that the simulator may lose in this time
# s lost by the simulator above which a failure is attributed to the slow computer: the actuators
# stop after so long without a command.
SLOW_TIME = 0.1
PAUSED = 'supervisor_paused'
PACING = 'sim_node: pacing'
# bridge -> (name of its status in diagnostics, prefix of the keys of a flight's measurements)
MEASURED = {
    'joint_bridge_node': ('bus', 'servos'), 'rotor_bridge_node': ('board', 'motor_board')}


class TooSlowError(RunError):
    """The computer is too slow to fly this flight in real time."""


class BridgeCounts:
    """
    Cycles and latencies of the bridges since this object was made, from their diagnostics.

    Args:
        values: status name -> its newest values.

    """

    def __init__(self, values: Callable[[str], dict[str, str]]):
        self._values = values
        self._first = self._cycles()

    def measured(self) -> dict[str, float]:
        """
        Return the counts and latencies [ms].

        Keys: ``servos_cycles``, ``servos_missed_cycles``, ``servos_latency_median_ms``,
        ``..._p99_ms`` and ``..._max_ms``, and the same for ``motor_board``. The latency is from
        the publication of `command` to its last byte written.
        """
        found = {}
        last = self._cycles()
        for node, (_, name) in MEASURED.items():
            for key in ('cycles', 'missed_cycles'):
                if f'{name}_{key}' in last:
                    found[f'{name}_{key}'] = \
                        last[f'{name}_{key}'] - self._first.get(f'{name}_{key}', 0)
            latency = self._values(f'{node}: latency')
            found.update({f'{name}_latency_{key}': float(latency[key])
                          for key in ('median_ms', 'p99_ms', 'max_ms') if key in latency})
        return found

    def _cycles(self):
        counts = {}
        for node, (status, name) in MEASURED.items():
            values = self._values(f'{node}: {status}')
            counts.update({f'{name}_{key}': int(values[key])
                           for key in ('cycles', 'missed_cycles') if key in values})
        return counts


class Flight:
    """
    One flight of a running graph.

    Args:
        graph: started nodes.
        operator: operator in the same ROS domain.
        task: task to fly.
        progress: display of the progress.
        may_be_slow: fly even if the simulator does not keep real time.
        faults: value of sim_node's parameter ``faults`` from the task's start on.

    Attributes:
        measured: CPU of the graph and of its bridges [% of one core], latencies [ms], cycles of
            the bridges; with simulated time, its ratio to real time and no latencies.

    """

    def __init__(self, graph: Graph, operator: Operator, task: Task, progress: Progress,
                 may_be_slow: bool = True, faults: str = ''):
        self._graph, self._operator, self._task = graph, operator, task
        self._bridges = [node for node in graph.nodes if node in BRIDGES]
        self._progress, self._faults, self._may_be_slow = progress, faults, may_be_slow
        self._bar = progress.add_task('', total=task.duration, at='')
        self._reported: set[str] = set()
        self.measured: dict[str, float] = {}

    def fly(self) -> None:
        """
        Wait for the graph, take off and fly the task to its end.

        Raises:
            TooSlowError: the simulator does not keep real time and ``may_be_slow`` is not set.
            RunError: any other failure.

        """
        operator = self._operator
        self._await('starting (the first time compiles the controller)',
                    lambda: operator.ready and operator.progress, READY_TIMEOUT)
        self._await('actuators', lambda: not operator.waits_for(self._bridges), BRIDGES_TIMEOUT)
        self._await('watching the simulator', lambda: PACING in operator.diagnostics,
                    BRIDGES_TIMEOUT)
        lost, begin = self._lost_time(), operator.time()
        if not self._may_be_slow:
            self._check_speed(lost)
        try:
            self._take_off()
            self._fly_task()
        except RunError as error:
            late, flown = self._lost_time() - lost, operator.time() - begin
            paused = any(PAUSED in state for state in operator.states)
            if late < SLOW_TIME and not paused:
                raise
            kind = RunError if self._may_be_slow else TooSlowError
            raise kind(f'{error}; the simulator fell {late:.1f} s behind in {flown:.0f} s'
                       + (', and supervisor_node was not scheduled' if paused else '')) from None
        self._take_latencies()

    def _check_speed(self, lost):
        """Check for a while whether the simulator keeps real time beside other programs."""
        self._spin(WATCH_TIME)
        if (late := self._lost_time() - lost) > LOST_TIME:
            raise TooSlowError(f'the simulator fell {late:.1f} s behind in {WATCH_TIME:g} s')

    def _lost_time(self):
        """Return the time that the simulator skipped because it was late [s]."""
        return float(self._operator.values(PACING).get('lost_s', 0.0))

    def _fly_task(self):
        operator, graph = self._operator, self._graph
        self._counts = BridgeCounts(operator.values)
        cpu, bridges_cpu = graph.cpu_seconds(), graph.cpu_seconds(bridges=True)
        start, steady = operator.time(), time.monotonic()
        if self._faults:
            self._inject_faults()
        left = operator.countdown(self._task.duration + SPARE_TIME)
        while not operator.progress.startswith('done'):
            self._spin()
            flown, passed = operator.time() - start, time.monotonic() - steady
            self._show(f'{self._task.name} ({operator.state})', operator.progress, flown)
            self.measured['cpu_percent'] = 100 * (graph.cpu_seconds() - cpu) / passed
            if self._bridges:
                self.measured['bridges_cpu_percent'] = \
                    100 * (graph.cpu_seconds(bridges=True) - bridges_cpu) / passed
            if graph.simulated:
                self.measured['real_time_factor'] = flown / passed
            if operator.state in ('disarmed', 'emergency_stop'):
                raise RunError(f"the flight ended early, supervisor in '{operator.state}'")
            if next(left, None) is None:
                raise RunError(f"the task does not continue at '{operator.progress}'")

    def _inject_faults(self):
        """Set the faults as the task begins, so that their times count from there."""
        operator = self._operator
        if not operator.wait(lambda: operator.progress.startswith('flying'), TAKEOFF_TIMEOUT):
            raise RunError(f"the task does not begin: '{operator.progress}'")
        accepted, answer = operator.set('sim_node', 'faults', self._faults)
        if not accepted:
            raise RunError(f'sim_node refuses the faults: {answer}')

    def _take_latencies(self):
        operator = self._operator
        if self._graph.simulated:
            return
        status, prefix = ('rotor_bridge_node', 'age_') if self._bridges else ('sim_node', '')
        for name in ('median_ms', 'p99_ms', 'max_ms'):
            value = operator.values(f'{status}: latency').get(prefix + name)
            if value is not None:
                self.measured[f'latency_{name}'] = float(value)
        self.measured.update(self._counts.measured())

    def _take_off(self):
        """Arm and take off; repeat if the supervisor disarms on the ground."""
        operator = self._operator
        for _ in range(TAKEOFF_ATTEMPTS):
            self._show('arming')
            left = operator.countdown(ARM_TIMEOUT)
            self._spin(SETTLE_TIME)
            while not (answer := operator.call('arm'))[0]:
                if next(left, None) is None:
                    raise RunError(f'supervisor_node refuses to arm: {answer[1]}')
                self._spin()
            operator.states.clear()
            # The state may name a fault: disarmed:joint1_jammed.
            self._await('taking off', lambda: operator.state.startswith('flying') or any(
                state.partition(':')[0] == 'disarmed' for state in operator.states),
                        TAKEOFF_TIMEOUT)
            if operator.state.startswith('flying'):
                return
        raise RunError(f'no take-off in {TAKEOFF_ATTEMPTS} attempts; see the warnings below')

    def land(self) -> None:
        """Land if the robot flies, and wait for the motors to stop."""
        operator = self._operator
        if operator.state in ('', 'disarmed', 'emergency_stop'):
            return
        self._show('landing')
        accepted, answer = operator.call('land')
        if not accepted:
            print(f'beetle_omni fly: error: no landing: {answer}', file=sys.stderr)
        else:
            operator.wait(lambda: operator.state in ('disarmed', 'emergency_stop'),
                          LANDING_TIMEOUT)
            operator.spin(1.1)      # the last diagnostics

    def _await(self, text, condition, timeout):
        self._show(text)
        left = self._operator.countdown(timeout)
        while not condition():
            self._spin()
            if next(left, None) is None:
                waits = self._operator.waits_for(self._bridges)
                raise RunError(f'{text}: nothing after {timeout:g} s, supervisor in '
                               f"'{self._operator.state}'" + (waits and f'; {waits}'))

    def _spin(self, seconds=CHECK_PERIOD):
        """Process messages; an ended process and a failing controller end the flight."""
        self._operator.spin(seconds)
        dead = {name: how for name, how in self._graph.dead().items()
                if name not in self._reported}
        self._reported |= set(dead)
        if dead:
            raise RunError('; '.join(f'{name} died ({how})' for name, how in dead.items()))
        operator = self._operator
        status = operator.diagnostics.get(f'{operator.controller}_node: controller')
        if status is not None and status.level >= ERROR \
                and not operator.state.startswith('flying'):
            raise RunError(status.message)

    def _show(self, text, at='', completed=0.0):
        self._progress.update(self._bar, description=text, at=at,
                          completed=min(completed, self._task.duration))
