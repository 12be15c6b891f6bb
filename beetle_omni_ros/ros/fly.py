"""`beetle_omni fly`: fly the ROS graph, record a bag, and print the results from the bag."""

from collections.abc import Callable
from contextlib import contextmanager, ExitStack
from functools import partial
import json
from pathlib import Path
import subprocess
import sys
import tempfile

from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import check_new, set_meta
from beetle_omni_ros.bags.log import motion
from beetle_omni_ros.bags.metrics import failed, metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight.component import ERROR
from beetle_omni_ros.flight.loop import ARMING_TIME
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.mode import FALLBACK
from beetle_omni_ros.model.parameters import find_robot, RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.ros import runner
from beetle_omni_ros.ros.clients import NEVER, Operator, SUPERVISOR
from beetle_omni_ros.ros.graph import (
    BRIDGES,
    child_environment,
    COMPOSED,
    Graph,
    plan,
    reserved_domain,
)
from beetle_omni_ros.show import table
from beetle_omni_ros.show.page import print_end
from beetle_omni_ros.sim.faults import DEVICES, load_faults
from beetle_omni_ros.supervisor.inputs import TOO_SLOW

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
SUPERVISOR_STATUS = f'{SUPERVISOR}: supervisor'
LATE = 'stale stamp', 'estimates_late', 'commands_late'     # in the names of its values
SLOW = 'this computer was too slow'
# By the actuators; emulated ones need real time.
ADVICE = {'direct': 'try --clock simulated',
          'emulated': 'close other programs, or try --actuators direct'}
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
        planned = partial(_planned, console, folder, controller, task, bag, robot, plant, seed,
                          injected)
        clock = more.pop('clock', 'auto')
        choice = clock == 'auto' and more.get('actuators') != 'emulated' and not injected
        clock = 'simulated' if clock == 'simulated' else 'system'
        nodes = planned(clock=clock, **more)
        number = stack.enter_context(reserved_domain()) if domain_id is None else domain_id
        if view:
            stack.enter_context(viewer_process(number, console))
        else:
            _print(console, f'to watch: beetle_omni view --domain-id {number}')
        meta = {'task': task, 'conditions': nodes['sim_node']['conditions'], 'seed': seed,
                'robot': str(robot) if robot else 'params/robot.yaml',
                'plant': str(plant) if plant else None, 'version': __version__,
                'controller': registry.find(controller).name,
                **({'faults': [str(fault) for fault in injected]} if injected else {})}
        while True:
            meta['clock'] = clock
            meta['actuators'] = nodes['sim_node'].get('actuators', 'direct')
            # the recorder's meta is that of an interrupted flight until the end
            nodes['recorder_node']['meta'] = json.dumps({**meta, 'interrupted': True})
            graph = Graph(nodes, folder, number)
            failure = slow = ''
            try:
                failure, slow = _fly(graph, meta['controller'], flown_task, console, clock, choice)
            except KeyboardInterrupt:
                meta['interrupted'] = True
            if not (choice and slow and failure):
                return _conclude(graph, Path(bag), flown_task, meta, failure, slow, json_path,
                                 console, full, view)
            _print(console, f'{slow}: flown again in simulated time', style='yellow')
            if bag.exists():
                late = bag.rename(bag.with_name(f'{bag.name}_late'))
                _print(console, f'bag of the late flight: {late}')
            choice, clock = False, 'simulated'
            nodes = planned(clock=clock, **more)


def _planned(console, folder, controller, task, bag, robot, plant, seed, faults, *, clock,
             nmpc=None, policy=None, standby=True, conditions='nominal', actuators=None,
             components=()):
    """Nodes of a flight with their parameters."""
    RobotParameters.load(plant or robot)
    nodes, left_out = plan(
        controller, nmpc=_absolute(nmpc), policy=str(policy or ''), standby=standby,
        robot_file=_absolute(robot and find_robot(robot)),
        plant_file=_absolute(plant and find_robot(plant)), conditions=conditions, seed=int(seed),
        task=_absolute(task) if Path(task).is_file() else str(task), bag=_absolute(bag),
        ports=str(folder), actuators=_checked(faults, actuators), components=components,
        clock=clock)
    nodes['sim_node']['task_faults'] = '; '.join(map(str, faults))
    if clock == 'simulated':    # it begins when all nodes are there
        nodes['sim_node']['pause_at'] = 0.0
    for name, reason in left_out.items():
        _print(console, f'{name} does not stand by: {reason}')
    return nodes


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
        slow = slow and f"{slow}: {ADVICE[meta['actuators']]}"
        if failure:
            _complain('; '.join(filter(None, (failure, slow))))
        elif slow:
            _print(console, slow, style='yellow')
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


def _fly(graph: Graph, controller: str, task: Task, console: Console, clock: str,
         choice: bool) -> tuple[str, str]:
    """
    Fly, and return why the flight failed, or '', and :meth:`Flight.slow`.

    With a ``choice`` of the clock, a flight on a computer that is too slow ends early.
    """
    failure, flight = '', None
    try:
        graph.start()
        with console.status('starting') as status:
            flight = Flight(graph, controller, task, status.update, choice)
            for part in (lambda: flight.fly(clock == 'simulated'), flight.land):
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

    def __init__(self, graph: Graph, controller: str, task: Task, show: Callable[[str], None],
                 choice: bool = False):
        super().__init__(graph.domain, controller)
        self._graph, self._task, self.show, self._lands = graph, task, show, False
        self._choice, self._answer = choice, ''     # of the supervisor to a request to arm
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
        if late >= SLOW_TIME:
            return f'{SLOW}, the simulator fell {late:.1f} s behind'
        fell_back = any(mode.state == FALLBACK for mode in self.states)
        if self._answer.endswith(TOO_SLOW) or fell_back and any(
                sign in key for key in self.values(SUPERVISOR_STATUS) for sign in LATE):
            return f'{SLOW}, its estimates or commands came late'
        return ''

    def _lost_time(self):
        """Return the time that the simulator skipped because it was late [s]."""
        return float(self.values(PACING).get('lost_s', 0.0))

    def arm(self) -> tuple[bool, str]:
        """Ask the supervisor to arm; simulated time stands still until it does."""
        accepted, self._answer = super().arm()
        if self._paused < NEVER:
            self._paused = NEVER if accepted else self._paused + TICK
            self.pause_at(self._paused)
        return accepted, self._answer

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
        if self._choice and self.state.state == FALLBACK and (slow := self.slow()):
            raise RunError(slow)
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
