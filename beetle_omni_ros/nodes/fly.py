"""`beetle_omni fly`: fly the ROS graph, record a bag, and print the results from the bag."""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import replace
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import threading

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.control import registry
from beetle_omni_ros.nodes import runner, speed
from beetle_omni_ros.nodes.discovery import confine, reserved_domain
from beetle_omni_ros.nodes.flight import Flight, TooSlowError
from beetle_omni_ros.nodes.graph import child_environment, Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.nodes.plan import ACTUATORS, GraphOptions, plan
from beetle_omni_ros.nodes.runner import signals_ignored, sigterm_as_interrupt
from beetle_omni_ros.robot.parameters import find_robot, RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import add_meta, BagError, check_new, read_bag
from beetle_omni_ros.runs.json_file import check_writable, write_json
from beetle_omni_ros.runs.metrics import failed, metrics
from beetle_omni_ros.runs.tasks import make_task, Task
from beetle_omni_ros.sim import fault_lists as listed

INTERRUPTED = 130
VIEWER_STOP_TIMEOUT = 3.0       # s
CLOCKS = {'auto': ('system', 'simulated'), 'system': ('system',), 'simulated': ('simulated',)}


def run_fly(*, controller: str = registry.DEFAULT, task: str = 'waypoints',
            bag: Path | None = None, compression: str = 'none',
            seed: int = 0, conditions: str = 'nominal',
            actuators: str | None = None,
            clock: str = 'auto', robot: Path | None = None, plant: Path | None = None,
            nmpc: Path | None = None, policy: Path | None = None,
            allow_other_robot: bool = False, standby: bool = True, composed: bool = True,
            faults: Path | None = None, json_path: Path | None = None,
            domain_id: int | None = None, discovery: str | None = None,
            view: bool = False, allow_targets: bool = False,
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
            stack.enter_context(sigterm_as_interrupt())
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='beetle_omni_')))
            bag = Path(bag).absolute() if bag else folder / 'bag'
            check_new(bag)
            check_writable(json_path)
            flown_task = make_task(task, seed, registry.find(controller).reach(
                RobotParameters.load(robot)))
            RobotParameters.load(plant or robot)
            robot_file, plant_file = (file and find_robot(file) for file in (robot, plant))
            injected = listed.load_faults(faults) if faults else []
            actuators = _actuators_for(injected, actuators)
            clocks = _clocks(clock, actuators)
            options = GraphOptions(
                controller=controller, nmpc=_absolute(nmpc), policy=str(policy or ''),
                standby=standby, allow_other_robot=allow_other_robot,
                robot_file=_absolute(robot_file), plant_file=_absolute(plant_file),
                conditions=conditions, seed=int(seed),
                task=_absolute(task) if Path(task).is_file() else str(task), bag=str(bag),
                compression=compression, actuators='direct', ports=str(folder))
            for name, reason in plan(options).left_out.items():
                _print(console, f'{name} does not stand by: {reason}')
            controller = registry.find(controller).name
            number = stack.enter_context(reserved_domain()) if domain_id is None else domain_id
            if view:
                stack.enter_context(viewer_process(number, robot, allow_targets, console))
            meta = {'task': task, 'conditions': conditions, 'seed': seed,
                    'robot': str(robot) if robot else 'params/robot.yaml',
                    'plant': str(plant) if plant else None, 'version': __version__,
                    'controller': controller, 'composed': composed}
            if injected:
                meta['faults'] = [str(fault) for fault in injected]
            status = _attempt(clocks, actuators, options, meta, folder, number, flown_task,
                              listed.text(injected), console)
            if not bag.exists():
                return status or runner.FAILED
            return max(status, _report(bag, controller, flown_task, meta, json_path, console))
    except (ParameterError, BagError, OSError) as error:
        print(f'beetle_omni fly: error: {error}', file=sys.stderr)
        return runner.UNUSABLE
    except KeyboardInterrupt:
        print('beetle_omni fly: interrupted; everything is stopped', file=sys.stderr)
        return INTERRUPTED


def _attempt(clocks, actuators, options, meta, folder, number, task, faults, console) -> int:
    """Fly by the first clock that the computer is fast enough for; extends ``meta``."""
    bag = Path(options.bag)
    for kind in clocks:
        meta |= {'clock': kind, 'actuators': actuators or (
            'direct' if kind == 'simulated' else 'emulated')}
        graph, last = _make_graph(options, meta, folder, number), kind == clocks[-1]
        try:
            if graph.composed and not last and (load := speed.load(graph.nodes)) > speed.MAX_LOAD:
                raise TooSlowError(f'the nodes would need {load:.0%} of a core')
            return _fly(graph, meta['controller'], task, meta, console, faults, may_be_slow=last)
        except TooSlowError as error:
            _discard_attempt(bag, folder, error, console)
        except KeyboardInterrupt:
            _save_meta(bag, meta)
            raise
    return runner.FAILED


def _actuators_for(faults, actuators):
    """
    Return the kind of actuators for a flight with these faults.

    Raises:
        ParameterError: a fault that the simulator cannot make with these actuators.

    """
    for fault in faults:
        if fault.is_process:
            raise ParameterError(f"--faults: '{fault.kind}' affects a process; expected a fault "
                                 'of the robot or its sensors')
        if fault.changes(*listed.DEVICES):
            if actuators == 'emulated':
                raise ParameterError(f"--faults: '{fault.kind}' affects a device; expected "
                                     '--actuators direct')
            actuators = 'direct'
    return actuators


@contextmanager
def viewer_process(domain_id: int, robot: Path | None, allow_targets: bool, console: Console
           ) -> Iterator[subprocess.Popen]:
    """Run `beetle_omni view` during a flight and print its lines on the console."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view',
         '--domain-id', str(domain_id),
         *(['--robot', str(robot)] if robot else []),
         *(['--allow-targets'] if allow_targets else [])],
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


def _clocks(clock, actuators):
    """Clocks to try in turn, until the computer is fast enough."""
    for key, value, known in (('actuators', actuators, (None, *ACTUATORS)),
                              ('clock', clock, CLOCKS)):
        if value not in known:
            raise ParameterError(f"{key} '{value}': expected {' or '.join(filter(None, known))}")
    if clock == 'simulated' and actuators == 'emulated':
        raise ParameterError("actuators 'emulated': serial devices keep real time; expected "
                             "direct with clock 'simulated'")
    return CLOCKS['system' if actuators == 'emulated' else clock]


def _make_graph(options, meta, folder, number):
    if meta['actuators'] == 'emulated':
        options = replace(options, actuators='bridges')
    return Graph(plan(options).nodes, folder, number, meta['composed'],
                 meta['clock'] == 'simulated')


def _discard_attempt(bag, folder, error, console):
    """Print why the flight is repeated, and delete bag and logs of the first attempt."""
    _print(console, f'this computer is too slow for real time: {error}; it flies in simulated '
          'time, which waits for the nodes, and without serial devices')
    shutil.rmtree(bag, ignore_errors=True)
    for log in folder.glob('*.log'):
        log.unlink()


def _save_meta(bag, meta):
    """Write the metadata into the bag of an interrupted flight, if there is one."""
    with signals_ignored():
        try:
            if (bag / 'metadata.yaml').exists():
                add_meta(bag, {**meta, 'interrupted': True})
        except BagError as error:
            print(f'beetle_omni fly: error: {error}', file=sys.stderr)


def _print(console, text):
    console.print(text, markup=False, emoji=False, highlight=False)


def _absolute(path):
    return str(Path(path).absolute()) if path else ''


def _fly(graph: Graph, controller: str, task: Task, meta: dict, console: Console,
         faults: str, may_be_slow: bool) -> int:
    status, failure = runner.OK, None
    operator = None
    try:
        graph.start()
        operator = Operator(graph.domain, controller)
        columns = (TextColumn('{task.description}'), BarColumn(),
                   TextColumn('{task.fields[at]}'), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bars:
            flight = Flight(graph, operator, task, bars, may_be_slow, faults)
            try:
                flight.fly()
            except TooSlowError:
                raise
            except RunError as error:
                print(f'beetle_omni fly: error: {error}', file=sys.stderr)
                status, failure = runner.FAILED, str(error)
            flight.land()
        meta['graph'] = flight.measured
        operator.report('fly: run', 'what is flown', {k: v for k, v in meta.items()
                                                      if not isinstance(v, dict)})
        operator.report('fly: graph', 'CPU of all nodes, latency of commands', flight.measured)
        operator.spin(0.2)
    finally:
        with signals_ignored():
            stubborn = graph.stop()
            if operator:
                operator.close()
    for name in stubborn:
        print(f'beetle_omni fly: error: {name} did not stop and was killed', file=sys.stderr)
    for line in graph.warnings():
        if failure and line.endswith(failure):
            continue        # printed above
        console.print(line, markup=False, emoji=False, highlight=False, style='yellow')
    return status


def _report(bag, controller, task, meta, json_path, console) -> int:
    if (bag / 'metadata.yaml').exists():
        add_meta(bag, {k: v for k, v in meta.items() if k != 'graph'})
    log = read_bag(bag)
    for line in log.warnings:
        console.print(line, markup=False, emoji=False, style='yellow')
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
