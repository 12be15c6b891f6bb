"""`beetle_omni fly`: fly the ROS graph, record a bag, and print the results from the bag."""

from contextlib import contextmanager, ExitStack
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.control import registry
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.nodes import runner
from beetle_omni_ros.nodes.graph import (
    BRIDGES,
    child_environment,
    confine,
    Graph,
    GraphOptions,
    plan,
    reserved_domain,
)
from beetle_omni_ros.nodes.node import ERROR
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.robot.parameters import find_robot, RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_writer import add_meta, check_new
from beetle_omni_ros.runs.files import check_writable, write_json
from beetle_omni_ros.runs.metrics import failed, metrics
from beetle_omni_ros.runs.tasks import make_task, Task
from beetle_omni_ros.sim import fault_lists as listed
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

INTERRUPTED = 130
VIEWER_STOP_TIMEOUT = 3.0       # s
ACTUATORS, CLOCKS = ('emulated', 'direct'), ('auto', 'system', 'simulated')

READY_TIMEOUT = 300.0   # s; the first start compiles the controller
BRIDGES_TIMEOUT = 20.0  # s; the simulator makes their devices at its start
ARM_TIMEOUT = 10.0      # s
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which start-up work ends
LANDING_TIMEOUT = 30.0  # s
SPARE_TIME = 10.0       # s beyond the task's duration before a flight counts as stuck
CHECK_PERIOD = 0.1      # s between checks of processes and progress
ON_GROUND = ('disarmed', 'emergency_stop')

MAX_LOAD = 0.9          # part of a core that the composed nodes may need in real time
PROBED = 1.0            # s of simulated time
# CPU of the seven nodes relative to plant and estimator, on two busy cores of a Xeon.
RELATIVE_LOAD = 12.8
# s lost by the simulator above which a failure is attributed to the slow computer: the actuators
# stop after so long without a command.
SLOW_TIME = 0.1
PACING = 'sim_node: pacing'
# bridge -> (name of its status in diagnostics, prefix of the keys of a flight's measurements)
MEASURED = {
    'joint_bridge_node': ('bus', 'servos'), 'rotor_bridge_node': ('board', 'motor_board')}
QUANTILES = ('median_ms', 'p99_ms', 'max_ms')


def run_fly(*, controller: str = registry.DEFAULT, task: str = 'waypoints',
            bag: Path | None = None, compression: str = 'none',
            seed: int = 0, conditions: str = 'nominal',
            actuators: str | None = None,
            clock: str = 'auto', robot: Path | None = None, plant: Path | None = None,
            nmpc: Path | None = None, policy: Path | None = None,
            allow_other_robot: bool = False, standby: bool = True, composed: bool = True,
            faults: Path | None = None, json_path: Path | None = None,
            domain_id: int | None = None, discovery: str | None = None,
            view: bool = False,
            console: Console | None = None) -> int:
    """
    Fly a task through the ROS graph and print the results of the bag.

    Arguments are the options of `beetle_omni fly`; without ``bag`` the bag is deleted.

    Returns:
        Exit status: 0 flown to the end, 1 not, 2 unusable input, 130 interrupted.

    """
    console = console or table.Terminal()
    try:
        if (discovery or '').strip().upper() == 'OFF':
            raise ParameterError('--discovery OFF: the nodes of a flight would not find each '
                                 'other; expected LOCALHOST, SUBNET or SYSTEM_DEFAULT')
        confine(requested=discovery)
        with ExitStack() as stack:
            stack.enter_context(runner.sigterm_as_interrupt())
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='beetle_omni_')))
            bag = Path(bag).absolute() if bag else folder / 'bag'
            check_new(bag)
            check_writable(json_path)
            flown_task = make_task(task, seed, registry.find(controller).reach(
                RobotParameters.load(robot)))
            RobotParameters.load(plant or robot)
            injected = listed.load_faults(faults) if faults else []
            actuators, clock = _actuators_and_clock(injected, actuators, clock, composed, console)
            planned = plan(GraphOptions(
                controller=controller, nmpc=_absolute(nmpc), policy=str(policy or ''),
                standby=standby, allow_other_robot=allow_other_robot,
                robot_file=_absolute(robot and find_robot(robot)),
                plant_file=_absolute(plant and find_robot(plant)),
                conditions=conditions, seed=int(seed),
                task=_absolute(task) if Path(task).is_file() else str(task), bag=str(bag),
                compression=compression, ports=str(folder), clock=clock,
                actuators='bridges' if actuators == 'emulated' else 'direct'))
            for name, reason in planned.left_out.items():
                _print(console, f'{name} does not stand by: {reason}')
            controller = registry.find(controller).name
            number = stack.enter_context(reserved_domain()) if domain_id is None else domain_id
            if view:
                stack.enter_context(viewer_process(number, console))
            meta = {'task': task, 'conditions': conditions, 'seed': seed,
                    'robot': str(robot) if robot else 'params/robot.yaml',
                    'plant': str(plant) if plant else None, 'version': __version__,
                    'controller': controller, 'composed': composed, 'clock': clock,
                    'actuators': actuators}
            if injected:
                meta['faults'] = [str(fault) for fault in injected]
            graph = Graph(planned.nodes, folder, number, composed)
            try:
                status = _fly(graph, controller, flown_task, meta, console, listed.text(injected))
            except KeyboardInterrupt:
                if (bag / 'metadata.yaml').exists():
                    add_meta(bag, {**meta, 'interrupted': True})
                raise
            if not bag.exists():
                return status or runner.FAILED
            return max(status, _report(bag, controller, flown_task, meta, json_path, console))
    except (ParameterError, OSError) as error:
        _complain(error)
        return runner.UNUSABLE
    except KeyboardInterrupt:
        print('beetle_omni fly: interrupted; everything is stopped', file=sys.stderr)
        return INTERRUPTED


def _actuators_and_clock(faults, actuators, clock, composed, console):
    """
    Choose what the user left open: devices need real time, real time a fast computer.

    Raises:
        ParameterError: unknown values, or faults that the simulator cannot make so.

    """
    for key, value, known in (('actuators', actuators, (None, *ACTUATORS)),
                              ('clock', clock, CLOCKS)):
        if value not in known:
            raise ParameterError(f"{key} '{value}': expected {' or '.join(filter(None, known))}")
    for fault in faults:
        if fault.is_process:
            raise ParameterError(f"--faults: '{fault.kind}' affects a process; expected a fault "
                                 'of the robot or its sensors')
        if fault.changes(*listed.DEVICES):
            if actuators == 'emulated':
                raise ParameterError(f"--faults: '{fault.kind}' affects a device; expected "
                                     '--actuators direct')
            actuators = 'direct'
    if clock == 'simulated' and actuators == 'emulated':
        raise ParameterError("actuators 'emulated': serial devices keep real time; expected "
                             "direct with clock 'simulated'")
    if clock == 'auto':
        clock = 'system'
        if composed and actuators != 'emulated' and (load := needed_load()) > MAX_LOAD:
            _print(console, 'this computer is too slow for real time: the nodes would need '
                   f'{load:.0%} of a core; it flies in simulated time, which waits for the '
                   'nodes, and without serial devices')
            clock = 'simulated'
    return actuators or ('direct' if clock == 'simulated' else 'emulated'), clock


def _absolute(path):
    return str(Path(path).absolute()) if path else ''


def needed_load() -> float:
    """
    Predict the CPU of a composed graph without bridges, as a part of a core.

    Plant and estimator run in this process for a simulated second. The nodes do the same work and
    move its messages, mostly in Python, too. So their CPU time is a multiple of it on any
    computer. The median of CPU times ignores other programs.
    """
    robot = RobotParameters.load()
    simulator = Simulator(robot, SimulatorParameters.load())
    estimator = ErrorStateEkf(EkfParameters.load().of_robot(robot), robot.gravity)
    used = []
    for _ in range(round(PROBED / simulator.tick)):
        begin = time.thread_time()
        frame = simulator.step()
        if frame.mocap is not None:
            estimator.pose(frame.mocap)
        if frame.imu is not None:
            estimator.imu(frame.imu)
        used.append(time.thread_time() - begin)
    return RELATIVE_LOAD * float(np.median(used)) / simulator.tick


@contextmanager
def viewer_process(domain_id: int, console: Console):
    """Run `beetle_omni view` during a flight and print its lines on the console."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view',
         '--domain-id', str(domain_id)],
        env=child_environment(domain_id), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        text=True, start_new_session=True)
    threading.Thread(target=lambda: [_print(console, line.rstrip()) for line in process.stdout],
                     daemon=True).start()
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(VIEWER_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _print(console, text, **style):
    console.print(text, markup=False, emoji=False, highlight=False, **style)


def _complain(error):
    print(f'beetle_omni fly: error: {error}', file=sys.stderr)


def _fly(graph: Graph, controller: str, task: Task, meta: dict, console: Console,
         faults: str) -> int:
    failure, operator = '', None
    try:
        graph.start()
        operator = Operator(graph.domain, controller)
        columns = (TextColumn('{task.description}'), BarColumn(),
                   TextColumn('{task.fields[at]}'), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bars:
            flight = Flight(graph, operator, task, bars, faults)
            try:
                flight.fly()
            except RunError as error:
                _complain(error)
                failure = str(error)
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
        _complain(f'{name} did not stop and was killed')
    for line in graph.warnings():
        if not failure or not line.endswith(failure):       # printed above
            _print(console, line, style='yellow')
    return runner.FAILED if failure else runner.OK


class Flight:
    """
    One flight of a running graph: start, arm, take off, fly the task, land.

    Args:
        graph: started nodes.
        operator: operator in the same ROS domain.
        task: task to fly.
        progress: display of the progress.
        faults: value of sim_node's parameter ``faults`` from the task's start on.

    Attributes:
        measured: CPU of the graph and of its bridges [% of one core], latencies [ms], cycles of
            the bridges; with simulated time, its ratio to real time and no latencies.

    """

    def __init__(self, graph: Graph, operator: Operator, task: Task, progress: Progress,
                 faults: str = ''):
        self._graph, self._operator, self._task = graph, operator, task
        self._bridges = [node for node in graph.nodes if node in BRIDGES]
        self._progress, self._faults = progress, faults
        self._bar = progress.add_task('', total=task.duration, at='')
        self._reported: set[str] = set()
        self.measured: dict[str, float] = {}

    def fly(self) -> None:
        """
        Wait for the graph, take off and fly the task to its end.

        Raises:
            RunError: a failure; the text states whether the computer was too slow.

        """
        operator = self._operator
        self._await('starting (the first time compiles the controller)',
                    lambda: operator.ready and operator.progress, READY_TIMEOUT)
        self._await('actuators', lambda: not operator.waits_for(self._bridges), BRIDGES_TIMEOUT)
        self._await('watching the simulator', lambda: PACING in operator.diagnostics,
                    BRIDGES_TIMEOUT)
        lost = self._lost_time()
        try:
            self._take_off()
            self._fly_task()
        except RunError as error:
            if (late := self._lost_time() - lost) < SLOW_TIME:
                raise
            raise RunError(f'{error}; this computer was too slow, the simulator fell {late:.1f} s '
                           'behind: try --clock simulated') from None

    def _lost_time(self):
        """Return the time that the simulator skipped because it was late [s]."""
        return float(self._operator.values(PACING).get('lost_s', 0.0))

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
            # The state may name a fault: disarmed:joint1_astray.
            self._await('taking off', lambda: operator.state.startswith('flying') or any(
                state.partition(':')[0] == 'disarmed' for state in operator.states),
                        TAKEOFF_TIMEOUT)
            if operator.state.startswith('flying'):
                return
        raise RunError(f'no take-off in {TAKEOFF_ATTEMPTS} attempts; see the warnings below')

    def _fly_task(self):
        operator, graph = self._operator, self._graph
        before, start, steady = self._counts(), operator.time(), time.monotonic()
        if self._faults:
            self._inject_faults()
        left = operator.countdown(self._task.duration + SPARE_TIME)
        while not operator.progress.startswith('done'):
            self._spin()
            self._show(f'{self._task.name} ({operator.state})', operator.progress,
                       operator.time() - start)
            if operator.state in ON_GROUND:
                raise RunError(f"the flight ended early, supervisor in '{operator.state}'")
            if next(left, None) is None:
                raise RunError(f"the task does not continue at '{operator.progress}'")
        passed = time.monotonic() - steady
        counts = {key: value - before.get(key, 0) for key, value in self._counts().items()}
        self.measured = {key: 100 * value / passed if key.endswith('percent') else value
                         for key, value in counts.items()}
        if graph.simulated:
            self.measured['real_time_factor'] = (operator.time() - start) / passed
        else:
            self._take_latencies()

    def _inject_faults(self):
        """Set the faults as the task begins, so that their times count from there."""
        operator = self._operator
        if not operator.wait(lambda: operator.progress.startswith('flying'), TAKEOFF_TIMEOUT):
            raise RunError(f"the task does not begin: '{operator.progress}'")
        accepted, answer = operator.set('sim_node', 'faults', self._faults)
        if not accepted:
            raise RunError(f'sim_node refuses the faults: {answer}')

    def _counts(self):
        """CPU seconds so far, and counts of the bridges' cycles from their diagnostics."""
        found = {'cpu_percent': self._graph.cpu_seconds()}
        if self._bridges:
            found['bridges_cpu_percent'] = self._graph.cpu_seconds(bridges=True)
        for node, (status, name) in MEASURED.items():
            values = self._operator.values(f'{node}: {status}')
            found |= {f'{name}_{key}': int(values[key])
                      for key in ('cycles', 'missed_cycles') if key in values}
        return found

    def _take_latencies(self):
        """Add the latencies of the loop, and of each bridge from `command` on."""
        status, prefix = ('rotor_bridge_node', 'age_') if self._bridges else ('sim_node', '')
        for name, node, prefix in (('latency', status, prefix), *(
                (f'{name}_latency', node, '') for node, (_, name) in MEASURED.items())):
            values = self._operator.values(f'{node}: latency')
            self.measured.update({f'{name}_{key}': float(values[prefix + key])
                                  for key in QUANTILES if prefix + key in values})

    def land(self) -> None:
        """Land if the robot flies, and wait for the motors to stop."""
        operator = self._operator
        if operator.state in ('', *ON_GROUND):
            return
        self._show('landing')
        accepted, answer = operator.call('land')
        if not accepted:
            _complain(f'no landing: {answer}')
        else:
            operator.wait(lambda: operator.state in ON_GROUND, LANDING_TIMEOUT)
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
        operator = self._operator
        operator.spin(seconds)
        dead = {name: how for name, how in self._graph.dead().items()
                if name not in self._reported}
        self._reported |= set(dead)
        if dead:
            raise RunError('; '.join(f'{name} died ({how})' for name, how in dead.items()))
        status = operator.diagnostics.get(f'{operator.controller}_node: controller')
        if status is not None and status.level >= ERROR \
                and not operator.state.startswith('flying'):
            raise RunError(status.message)

    def _show(self, text, at='', completed=0.0):
        self._progress.update(self._bar, description=text, at=at,
                              completed=min(completed, self._task.duration))


def _report(bag, controller, task, meta, json_path, console) -> int:
    if (bag / 'metadata.yaml').exists():
        add_meta(bag, {k: v for k, v in meta.items() if k != 'graph'})
    log = read_bag(bag)
    for line in log.warnings:
        _print(console, line, style='yellow')
    results = {'meta': meta, controller: metrics(log, task)}
    if log.controllers():       # a controller flew
        table.print_results(results, console)
    _print_measured(meta, console)
    write_json(json_path, results)
    return runner.FAILED if failed(results[controller]) else runner.OK


def _print_measured(meta, console):
    measured = meta.get('graph', {})
    if 'cpu_percent' in measured:
        nodes = 'composed (all nodes in one process)' if meta['composed'] else 'separate processes'
        console.print(f"graph: {nodes}, CPU {measured['cpu_percent']:.0f} % of one core while the "
                      'task was flown'
                      + (f", of it {measured['bridges_cpu_percent']:.0f} % in the bridges"
                         if 'bridges_cpu_percent' in measured else ''))
    if 'real_time_factor' in measured:
        console.print(f"simulated time: {measured['real_time_factor']:.2f} of real time")
    if 'latency_p99_ms' in measured:
        end = 'its command at the actuators' if meta['actuators'] == 'direct' \
            else 'the last byte of its command to the motor board'
        console.print(f"latency, stamp of the IMU sample to {end}: {_times(measured, 'latency')}")
    for name, text in (('servos', 'servo bus'), ('motor_board', 'motor board')):
        if f'{name}_cycles' in measured:
            console.print(f"{text}: {measured[f'{name}_cycles']} cycles of 5 ms, "
                          f"{measured[f'{name}_missed_cycles']} missed; `command` to its last "
                          f"byte: {_times(measured, f'{name}_latency')}")


def _times(measured, key):
    return (f"median {measured[f'{key}_median_ms']:.2f} ms, 99th percentile "
            f"{measured[f'{key}_p99_ms']:.2f} ms, max {measured[f'{key}_max_ms']:.1f} ms")
