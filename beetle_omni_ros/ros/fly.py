"""`beetle_omni fly`: fly the ROS graph, record a bag, and print the results from the bag."""

from collections.abc import Callable
from contextlib import contextmanager, ExitStack, suppress
from functools import partial
import json
import os
from pathlib import Path
from statistics import median
import subprocess
import sys
import tempfile
import time

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import check_new, set_meta
from beetle_omni_ros.bags.log import motion, Recorder
from beetle_omni_ros.bags.metrics import failed, metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight.component import ERROR, made
from beetle_omni_ros.flight.loop import ARMING_TIME, collector_off, FlightLoop
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import find_robot, RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.ros import runner
from beetle_omni_ros.ros.clients import NEVER, Operator
from beetle_omni_ros.ros.graph import (
    BRIDGES,
    child_environment,
    COMPOSED,
    CONTROLLER,
    Graph,
    NODES,
    Parameters,
    plan,
    reserved_domain,
)
from beetle_omni_ros.ros.runner import REAL_TIME_PRIORITY
from beetle_omni_ros.show import table
from beetle_omni_ros.show.page import print_end
from beetle_omni_ros.sim.faults import DEVICES, load_faults

READY_TIMEOUT = 300.0   # s; the first start compiles the controller
BRIDGES_TIMEOUT = 20.0  # s; the simulator makes their devices at its start
LANDING_TIMEOUT = 30.0  # s
TICK = 0.005            # s between two attempts to arm in simulated time
LOG = 'nodes.log'       # in the bag: what the nodes logged, in the order of time
SPARE_TIME = 10.0       # s beyond the task's duration before a flight counts as stuck

# s lost by the simulator above which a failure is attributed to the slow computer: the actuators
# stop after so long without a command.
SLOW_TIME = 0.1
PACING = 'sim_node: pacing'
FILM = 'flight.html'        # of --view, in the folder of the bag


def run_fly(*, bag: Path, controller: str = registry.DEFAULT, task: str = 'waypoints',
            robot: Path | None = None, plant: Path | None = None, seed: int = 0,
            faults: Path | None = None, json_path: Path | None = None,
            domain_id: int | None = None, view: bool = False, full: bool = False,
            console: Console | None = None, **more) -> int:
    """
    Fly a task through the ROS graph and print the results of the bag.

    Arguments are the options of `beetle_omni fly`; ``more`` are those of the graph alone.

    Returns:
        Exit status: 0 flown to the end, 1 not.

    Raises:
        ParameterError: unusable input.

    """
    console = console or table.Terminal()
    with ExitStack() as stack:
        stack.enter_context(runner.sigterm_as_interrupt())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='beetle_omni_')))
        check_new(bag)
        flown_task = make_task(task, seed, registry.find(controller).reach(
            RobotParameters.load(robot)))
        injected = load_faults(faults) if faults else []
        nodes, clock = _planned(console, folder, controller, task, bag, robot, plant, seed,
                                injected, **more)
        number = stack.enter_context(reserved_domain()) if domain_id is None else domain_id
        if view:
            stack.enter_context(viewer_process(number, console))
        else:
            _print(console, f'to watch: beetle_omni view --domain-id {number}')
        meta = {'task': task, 'conditions': nodes['sim_node']['conditions'], 'seed': seed,
                'robot': str(robot) if robot else 'params/robot.yaml',
                'plant': str(plant) if plant else None, 'version': __version__,
                'controller': registry.find(controller).name, 'clock': clock,
                'actuators': nodes['sim_node'].get('actuators', 'direct'),
                **({'faults': [str(fault) for fault in injected]} if injected else {})}
        nodes['recorder_node']['meta'] = json.dumps({**meta, 'interrupted': True})  # to the end
        graph = Graph(nodes, folder, number)
        failure = slow = ''
        try:
            failure, slow = _fly(graph, meta['controller'], flown_task, console,
                                 clock == 'simulated')
        except KeyboardInterrupt:
            meta['interrupted'] = True
        return _conclude(graph, Path(bag), flown_task, meta, failure, slow, json_path, console,
                         full, view)


def _planned(console, folder, controller, task, bag, robot, plant, seed, faults, *,
             nmpc=None, policy=None, standby=True, conditions='nominal', actuators=None,
             clock='auto', components=()):
    """Nodes of a flight with their parameters, and its clock."""
    RobotParameters.load(plant or robot)
    planned = partial(
        plan, controller, nmpc=_absolute(nmpc), policy=str(policy or ''), standby=standby,
        robot_file=_absolute(robot and find_robot(robot)),
        plant_file=_absolute(plant and find_robot(plant)), conditions=conditions, seed=int(seed),
        task=_absolute(task) if Path(task).is_file() else str(task), bag=_absolute(bag),
        ports=str(folder), actuators=_checked(faults, actuators), components=components)
    nodes, left_out = planned(clock='system' if clock == 'auto' else clock)
    if clock == 'auto':
        clock = _clock(nodes, robot, actuators, console)
        nodes, left_out = planned(clock=clock)
    nodes['sim_node']['task_faults'] = '; '.join(map(str, faults))
    if clock == 'simulated':    # it begins when all nodes are there
        nodes['sim_node']['pause_at'] = 0.0
    for name, reason in left_out.items():
        _print(console, f'{name} does not stand by: {reason}')
    return nodes, clock


def _clock(nodes, robot, actuators, console):
    """Choose the clock of a flight by the pace of this computer, and say so in one line."""
    with console.status('measuring the pace (the first time compiles the controller)'):
        share, reason = too_slow(nodes, robot)
    if not reason:
        _print(console, f'real time: the flight needs {100 * share:.0f} % of a core')
    elif actuators == 'emulated':
        _print(console, f'{reason}; emulated devices have real time only', style='yellow')
    else:
        _print(console, f'{reason}; simulated time is used', style='yellow')
        return 'simulated'
    return 'system'


def _conclude(graph, bag, task, meta, failure, slow, json_path, console, full, film) -> int:
    """Report the flight of a bag and why it failed; return the exit status."""
    log = bag / LOG if bag.is_dir() else bag.with_name(f'{bag.name}.log')
    write_text(log, ''.join(f'{line}\n' for line in graph.lines()), 'log')
    try:
        if bag.exists() and not failure.startswith(str(bag.absolute())):    # of the recorder
            result = _report(bag, meta['controller'], task, meta, json_path, console, full, film)
            failure = failure or failed(result)
        if 'interrupted' in meta:
            raise KeyboardInterrupt
        if failure:
            _complain(failure + slow)
        elif slow:
            _print(console, slow.removeprefix('; '), style='yellow')
    finally:
        page = bag / FILM
        print_end(console, [bag, log, *([page] if page.exists() else []), json_path],
                  *([('report', bag), ('view', bag)] if bag.exists() else ()))
    return runner.FAILED if failure else runner.OK


def _checked(faults, actuators):
    """Refuse faults that a flight cannot have; those of devices need direct actuators."""
    for fault in faults:
        if fault.is_process:
            raise ParameterError(f"--faults: '{fault.kind}' affects a process; expected a fault "
                                 'of the robot or its sensors')
        if fault.changes(*DEVICES):
            if actuators == 'emulated':
                raise ParameterError(f"--faults: '{fault.kind}' affects a device; expected "
                                     '--actuators direct')
            actuators = 'direct'
    return actuators


def _absolute(path):
    return str(Path(path).absolute()) if path else ''


@contextmanager
def viewer_process(domain_id: int, console: Console):
    """Run `beetle_omni view` during a flight, and print its address."""
    command = [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view', '--domain-id',
               str(domain_id)]
    with subprocess.Popen(command, env=child_environment(domain_id), stdin=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            _print(console, process.stdout.readline().rstrip())
            yield
        finally:
            process.kill()


def _print(console, text, **style):
    console.print(text, markup=False, emoji=False, highlight=False, soft_wrap=True, **style)


def _complain(error):
    print(f'beetle_omni fly: error: {error}', file=sys.stderr)


def _fly(graph: Graph, controller: str, task: Task, console: Console,
         simulated: bool) -> tuple[str, str]:
    """Fly, and return why the flight failed, or '', and :meth:`Flight.slow`."""
    failure, flight = '', None
    try:
        graph.start()
        with console.status('starting') as status:
            flight = Flight(graph, controller, task, status.update)
            for part in (lambda: flight.fly(simulated), flight.land):
                try:
                    part()
                except RunError as error:
                    failure = failure or str(error)
    finally:
        stubborn = graph.stop(in_flight=bool(flight and flight.state.in_flight))
        if flight:
            flight.close()
    for name in stubborn:
        _complain(f'{name} did not stop and was killed')
    for line in graph.warnings():
        if line.startswith('recorder_node: error: '):
            failure = failure or line.partition(' error: ')[2]
        elif not failure or not line.endswith(failure):     # printed at the end
            _print(console, line, style='yellow')
    return failure, flight.slow()


class Flight(Operator):
    """One flight of a started graph: arm, take off, fly the task, land."""

    def __init__(self, graph: Graph, controller: str, task: Task, show: Callable[[str], None]):
        super().__init__(graph.domain, controller)
        self._graph, self._task, self.show, self._lands = graph, task, show, False
        self._lost_before = float('inf')    # s, of the simulator before the take-off
        self._paused = NEVER    # s, at which simulated time stands still
        self.required = [node for node in graph.nodes if node in BRIDGES]

    def fly(self, simulated: bool = False) -> None:
        """
        Wait for the graph, take off and fly the task to its end.

        With ``simulated`` time the robot arms at the moment at which the loop arms it. A RunError
        reports a failure.
        """
        self.expect('starting (the first time compiles the controller)',
                    lambda: self.ready and self.progress, READY_TIMEOUT)
        self.expect('actuators and simulator', lambda: not self.waits_for(self.required)
                    and PACING in self.diagnostics, BRIDGES_TIMEOUT)
        self._lost_before = self._lost_time()
        if simulated:
            self._paused = ARMING_TIME
            self.pause_at(ARMING_TIME)
        self.take_off()
        self._fly_task()

    def slow(self) -> str:
        """Return a text if the computer was too slow, else ''."""
        late = self._lost_time() - self._lost_before
        return '' if late < SLOW_TIME else f'; this computer was too slow, the simulator fell ' \
            f'{late:.1f} s behind: try --clock simulated'

    def _lost_time(self):
        """Return the time that the simulator skipped because it was late [s]."""
        return float(self.values(PACING).get('lost_s', 0.0))

    def arm(self) -> tuple[bool, str]:
        """Ask the supervisor to arm; simulated time stands still until it does."""
        accepted, answer = super().arm()
        if self._paused < NEVER:
            self._paused = NEVER if accepted else self._paused + TICK
            self.pause_at(self._paused)
        return accepted, answer

    def _fly_task(self):
        name, start = self._task.name, self.time()

        def is_done():
            self.show(f'{name}: {self.progress}, {self.time() - start:.0f} of '
                       f'{self._task.duration:.0f} s ({self.state})')
            if self.state.motors_off:
                raise RunError(f"the flight ended early, supervisor in '{self.state.state}'")
            return self.progress.startswith('done')

        self.expect(name, is_done, self._task.duration + SPARE_TIME,
                    lambda: f"; the task does not continue at '{self.progress}'")

    def land(self) -> None:
        """Land if the robot flies, and wait for the motors to stop; RunError: no landing."""
        self._lands = True
        if not self.state.in_flight or COMPOSED in self._graph.dead():
            return      # a dead supervisor does not answer, and its clock stands still
        accepted, answer = self.call('land')
        if not accepted:
            raise RunError(f'no landing: {answer}')
        self.expect('landing', lambda: self.state.motors_off, LANDING_TIMEOUT)
        self.spin(1.1)      # the last diagnostics

    def spin(self, seconds: float) -> None:
        """Process messages; before landing, the end of a process, controller or bag raises."""
        super().spin(seconds)
        if self._lands:
            return
        if dead := self._graph.dead():
            raise RunError('; '.join(f'{name} died ({how})' for name, how in dead.items()))
        status = self.diagnostics.get(f'{self.controller}_node: controller')
        if status is not None and status.level >= ERROR and not self.state.controller:
            raise RunError(status.message)
        status = self.diagnostics.get('recorder_node: bag')
        if status is not None and status.level >= ERROR:
            raise RunError(status.message)


def _report(bag, controller, task, meta, json_path, console, full, film) -> dict:
    if (bag / 'metadata.yaml').exists():
        set_meta(bag, meta)
    log = read_bag(bag)
    for line in log.warnings:
        _print(console, line, style='yellow')
    results = {'meta': meta, controller: metrics(log, task)}
    if log.targets:     # a controller flew
        table.print_results(results, console, full=full)
    write_json(json_path, results)
    if film and len(motion(log)):
        from beetle_omni_ros.show.recorded import recorded_scene  # viser takes a second
        write_text(bag / FILM, recorded_scene({controller: log}), 'film')
    return results[controller]


# Time of the graph's process, in times of the loop: messages and callbacks in Python. Measured
# by benchmarks/graph.py, see docs/results/ros_graph.md.
GRAPH = 4.0
MOST = 0.95         # of a core that the graph's process may need
CORES = 2           # one for the graph, one for bridges, operator, viewer and browser
WINDOW, WINDOWS = 0.25, 7   # [s] of simulated time; the median of the windows counts


def too_slow(nodes: Parameters, robot: Path | None) -> tuple[float, str]:
    """
    Return the share of a core that a graph in real time needs, and why it is too much, or ''.

    The controllers, the estimator, the supervisor and the simulator of ``nodes`` fly in the loop
    for a moment, with the priority of the graph. A ParameterError reports an unusable controller.
    """
    share = GRAPH * _time_of_loop(_loop(nodes, RobotParameters.load(robot)))
    cores = len(os.sched_getaffinity(0))
    if cores < CORES:
        return share, f'real time needs {CORES} cores, this computer has {cores}'
    if share > MOST:
        return share, ('this computer is too slow for real time: the flight needs '
                       f'{100 * share:.0f} % of a core, expected at most {100 * MOST:.0f} %')
    return share, ''


def _loop(nodes, robot):
    """The nodes' flight in one process."""
    aboard, components = {}, []
    for name, values in nodes.items():
        if 'component' in values:
            components.append(values['component'])
        elif NODES.get(name, CONTROLLER) == CONTROLLER:
            entry = registry.find(values.get('controller') or name.removesuffix('_node'))
            aboard[entry.name] = entry.make(robot, ControllerOptions(
                parameters=values.get(f'{entry.name}_file'), policy=values.get('policy')))
    return FlightLoop(robot, robot, aboard, Recorder(), others=made(components, robot))


def _time_of_loop(loop):
    """Time of a simulated second in flight, at real-time priority if the system permits it."""
    times, before = [], (os.sched_getscheduler(0), os.sched_getparam(0))
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(REAL_TIME_PRIORITY))
    try:
        with collector_off():
            with suppress(RunError):    # the graph reports it
                loop.take_off()
            for _ in range(WINDOWS):
                begin = time.perf_counter()
                loop.run(WINDOW)
                times.append(time.perf_counter() - begin)
    finally:
        os.sched_setscheduler(0, *before)
    return median(times) / WINDOW
