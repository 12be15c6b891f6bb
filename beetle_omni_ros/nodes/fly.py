"""`beetle_omni fly`: the whole graph in real time, a bag, and the table from the bag."""

from __future__ import annotations

from contextlib import contextmanager, ExitStack
import os
from pathlib import Path
import signal
import sys
import tempfile
import threading
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.nodes import domain, runner
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.nodes.standby import controller_nodes
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import add_meta, BagError, check_new, read_bag
from beetle_omni_ros.runs.json_file import check_writable, write_json
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import make_task, Task

READY_TIMEOUT = 300.0   # s; the first start compiles the controller
ARM_TIMEOUT = 10.0      # s
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which all processes come to rest
LANDING_TIMEOUT = 30.0  # s
SPARE_TIME = 10.0       # s beyond the task's duration before a flight counts as stuck
LOOK_PERIOD = 0.1       # s between looks at processes and progress
INTERRUPTED = 130


class FlightError(RuntimeError):
    """The flight did not go as asked; the text is one line for the operator."""


def run_fly(*, controller: str = 'nmpc', task: str = 'waypoints', bag: Path | None = None,
            seed: int = 0, conditions: str = 'nominal', robot: Path | None = None,
            plant: Path | None = None, policy: Path | None = None,
            allow_other_robot: bool = False, standby: bool = True, composed: bool = True,
            json_path: Path | None = None,
            domain_id: int | None = None, console: Console | None = None) -> int:
    """
    Fly a task through the ROS graph and print what the bag says.

    Args:
        controller: the active controller, 'nmpc' or 'rl'.
        task: name or pose file.
        bag: folder to create; None: the bag is thrown away.
        seed: of the task and the simulation.
        conditions: 'nominal' or 'published'.
        robot: file that estimator and controller believe; default the shipped one.
        plant: file that is true in the simulation; default ``robot``.
        policy: file for 'rl'; default the shipped one.
        allow_other_robot: fly a policy that was trained for other robot parameters.
        standby: run the other controller too, so that it can be selected in flight.
        composed: all nodes in one process, or one process for each.
        json_path: file for the results.
        domain_id: ROS domain; default a free one.
        console: where to print.

    Returns:
        Exit status: 0 flown to the end, 1 not, 2 unusable input, 130 interrupted.

    """
    console = console or Console()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='beetle_omni_')))
            bag = Path(bag).absolute() if bag else folder / 'bag'
            check_new(bag)
            if json_path:
                check_writable(json_path)
            flown = make_task(task, seed)
            RobotParameters.load(plant or robot)
            meta = {'task': task, 'conditions': conditions, 'seed': seed,
                    'robot': str(robot) if robot else 'params/robot.yaml',
                    'plant': str(plant) if plant else None, 'version': __version__,
                    'controller': controller, 'composed': composed}
            controllers, left_out = controller_nodes(
                controller, robot_file=str(Path(robot).absolute()) if robot else '',
                policy=str(policy or ''), allow_other_robot=allow_other_robot, standby=standby)
            if left_out:
                console.print(f'rl does not stand by: {left_out}', markup=False, emoji=False,
                              highlight=False)
            parameters = _parameters(controllers, task, bag, seed, conditions, robot, plant)
            parameters['supervisor_node']['controller'] = controller
            number = stack.enter_context(domain.reserved()) if domain_id is None else domain_id
            graph = Graph(parameters, folder, number, composed)
            stack.enter_context(_terminable())
            status = _fly(graph, controller, flown, meta, console)
            if not bag.exists():
                return status or runner.FAILED
            return max(status, _report(bag, controller, flown, meta, json_path, console))
    except (ParameterError, BagError, OSError) as error:
        print(f'beetle_omni fly: error: {error}', file=sys.stderr)
        return runner.UNUSABLE
    except KeyboardInterrupt:
        print('beetle_omni fly: interrupted; everything is stopped', file=sys.stderr)
        return INTERRUPTED


def _parameters(controllers, task, bag, seed, conditions, robot, plant):
    """Node name -> parameters of the graph."""
    believed = {'robot_file': str(Path(robot).absolute())} if robot else {}
    true = {'robot_file': str(Path(plant).absolute())} if plant else believed
    task_file = str(Path(task).absolute()) if Path(task).is_file() else str(task)
    return {'recorder_node': {'bag': str(bag)},
            'sim_node': {**true, 'conditions': conditions, 'seed': int(seed)},
            'ekf_node': believed,
            **controllers,
            'supervisor_node': dict(believed),
            'reference_node': {'task': task_file, 'seed': int(seed)}}


def _fly(graph: Graph, controller: str, task: Task, meta: dict, console: Console) -> int:
    """Start, fly, land, stop; report every fault by the node's name."""
    status = runner.OK
    operator = None
    try:
        graph.start()
        operator = Operator(graph.domain, controller)
        columns = (TextColumn('{task.description}'), BarColumn(),
                   TextColumn('{task.fields[at]}'), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bars:
            flight = Flight(graph, operator, task, bars)
            try:
                flight.fly()
            except FlightError as error:
                print(f'beetle_omni fly: error: {error}', file=sys.stderr)
                status = runner.FAILED
            flight.land()
        meta['graph'] = flight.measured
        operator.report('fly: run', 'what is flown', {k: v for k, v in meta.items()
                                                      if not isinstance(v, dict)})
        operator.report('fly: graph', 'CPU of all nodes, latency of commands', flight.measured)
        operator.spin(0.2)
    finally:
        stubborn = graph.stop()
        if operator:
            operator.close()
    for name in stubborn:
        print(f'beetle_omni fly: error: {name} did not stop and was killed', file=sys.stderr)
    for line in graph.warnings():
        console.print(line, markup=False, emoji=False, highlight=False, style='yellow')
    return status


class Flight:
    """
    One flight of a running graph.

    Attributes:
        measured: CPU of the graph [% of one core] and latency of commands [ms].

    """

    def __init__(self, graph: Graph, operator: Operator, task: Task, bars: Progress):
        """Prepare the bar."""
        self._graph, self._operator, self._task = graph, operator, task
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
        self._take_off()
        cpu, start = self._graph.cpu_seconds(), time.monotonic()
        while not operator.progress.startswith('done'):
            self._look()
            flown = time.monotonic() - start
            self._say(f'{self._task.name} ({operator.state})', operator.progress, flown)
            self.measured['cpu_percent'] = \
                100 * (self._graph.cpu_seconds() - cpu) / (time.monotonic() - start)
            if operator.state in ('disarmed', 'emergency_stop'):
                raise FlightError(f"the flight ended early, supervisor in '{operator.state}'")
            if flown > self._task.duration + SPARE_TIME:
                raise FlightError(f"the task hangs at '{operator.progress}'")
        for name, key in (('median_ms', 'latency_median_ms'), ('p99_ms', 'latency_p99_ms'),
                          ('max_ms', 'latency_max_ms')):
            value = operator.values('sim_node: latency').get(name)
            if value is not None:
                self.measured[key] = float(value)

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
                raise FlightError(f'{text}: nothing after {timeout:g} s, supervisor in '
                                  f"'{self._operator.state}'")

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


def _report(bag, controller, task, meta, json_path, console) -> int:
    """Print and write the results, all from the bag."""
    if (bag / 'metadata.yaml').exists():
        add_meta(bag, {k: v for k, v in meta.items() if k != 'graph'})
    log = read_bag(bag)
    for line in log.warnings:
        console.print(line, markup=False, emoji=False, style='yellow')
    results = {'meta': meta, controller: metrics(log, task)}
    table.print_results(results, console)
    measured = meta.get('graph', {})
    if 'cpu_percent' in measured:
        console.print(f"graph: {'one process' if meta['composed'] else 'separate processes'}, CPU "
                      f"{measured['cpu_percent']:.0f} % of one core while the task was flown")
    if 'latency_p99_ms' in measured:
        console.print('latency, stamp of the IMU sample to the arrival of its command at the '
                      f"actuators: median {measured['latency_median_ms']:.2f} ms, 99th percentile "
                      f"{measured['latency_p99_ms']:.2f} ms, max "
                      f"{measured['latency_max_ms']:.1f} ms")
    if json_path:
        write_json(json_path, results)
    return runner.OK if not results[controller].get('crashed') else runner.FAILED


@contextmanager
def _terminable():
    """Let SIGTERM end a flight as Ctrl-C does, so that nothing is left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
