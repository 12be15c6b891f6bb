"""`beetle_omni check`: findings about ports, servos, motor board and topics, with remedies."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from statistics import fmean, median

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

OK, WARN, FAIL = 'ok', 'warn', 'fail'
# Bridge -> page about its faults.
BRIDGES = {'joint_bridge': 'docs/reference/hardware_faults.md: what happens when',
           'rotor_bridge': 'docs/reference/firmware.md: outcome of faults'}
UNUSED = ('node', 'inputs', 'compute')      # statuses of every node; the topics cover them
MOCAP, IMU = 'mocap/pose', 'imu/data_raw'
MISSED = 3              # missing messages in a row that count as a pause
CLOCK_SPREAD = 0.2      # relative spread of large ages below which clocks are the cause
# [-] of the nominal rate; above the upper limit the estimator is tuned for another rate
RATE, RATE_FAIL = (0.95, 1.2), (0.8, inf)
AHEAD = 0.001           # [s] stamps farther ahead of this clock: clocks not synchronised
GAP = 0.1               # [s] longest pause between two messages without a warning
GRAVITY_TOLERANCE = 1.0     # [m/s^2] mean specific force at rest minus gravity
# Topic -> publisher, the bridge that publishes it, rate [Hz], ages of the freshest message that
# warn and fail [s]. A MoCap needs about 10 ms, and the network; at 0.1 s the estimator is dead
# reckoning. The other ages that fail are those after which the supervisor acts. The board reports
# its battery at 50 Hz, the simulator at 10 Hz.
TOPICS = {MOCAP: ('the MoCap driver', '', 100.0, 0.03, 0.1),
          IMU: ('the IMU driver', '', 200.0, 0.01, 0.05),
          'joint_states': ('joint_bridge_node', 'joint_bridge', 200.0, 0.02, 0.2),
          'battery_state': ('rotor_bridge_node', 'rotor_bridge', 10.0, 0.1, 2.0)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the result."""

    item: str           # name of the checked item, stable for scripts
    level: str          # 'ok', 'warn' (the robot can fly, but look at the item) or 'fail'
    found: str          # description with numbers and units
    remedy: str = ''    # what to do; '' for level 'ok'
    # Numbers behind ``found``; each key ends with the unit.
    values: Mapping[str, float | int | str | None] = field(default_factory=dict)


class Findings(list[Finding]):
    """Findings in the order of the checks."""

    def add(self, item: str, found: str, *, fail: str = '', warn: str = '',
            **values: float | int | str | None) -> None:
        """Add a finding; the remedy ``fail`` or ``warn`` determines its level, none is 'ok'."""
        level = FAIL if fail else WARN if warn else OK
        self.append(Finding(item, level, found, fail or warn, values))

    def grade(self, item: str, found: str, value: float, remedy: str, *,
              warn: tuple[float, float] = (-inf, inf), fail: tuple[float, float] = (-inf, inf),
              **values) -> None:
        """Add a finding about ``value``: 'warn' or 'fail' outside these limits."""
        self.add(item, found, fail='' if fail[0] <= value <= fail[1] else remedy,
                 warn='' if warn[0] <= value <= warn[1] else remedy, **values)


# --- the observed graph -------------------------------------------------------------------------

@dataclass
class Stream:
    """Messages of one topic."""

    arrivals: list[float] = field(default_factory=list)     # times on a monotonic clock [s]
    # Clock of this computer minus stamp, at arrival [s]; the smallest is the latency plus the
    # offset between the clocks.
    ages: list[float] = field(default_factory=list)
    norms: list[float] = field(default_factory=list)    # of vectors, equal only of a frozen sensor
    refused: Counter = field(default_factory=Counter)   # reason -> number of unusable messages
    publishers: list[str] = field(default_factory=list)     # names of the publishing nodes
    other_types: list[str] = field(default_factory=list)    # under which it is published, too


@dataclass
class ObservedGraph:
    """Everything observed during one check."""

    domain: int = 0         # ROS domain
    seconds: float = 0.0    # duration of the observation [s]
    streams: dict[str, Stream] = field(default_factory=dict)    # topic -> its messages
    states: dict[str, str] = field(default_factory=dict)    # 'joint_bridge' -> its latched state
    diagnostics: dict[str, Diagnostic] = field(default_factory=dict)    # name -> the newest one

    def of_bridge(self, bridge: str) -> dict[str, Diagnostic]:
        """Diagnostics of a bridge's node: name without the prefix 'NODE: ' -> status."""
        start = f'{bridge}_node: '
        return {name.removeprefix(start): status for name, status in self.diagnostics.items()
                if name.startswith(start)}

    def runs(self, bridge: str) -> bool:
        """Whether a state or a diagnostic of the bridge arrived."""
        return bridge in self.states or bool(self.of_bridge(bridge))


def _reports_of(findings, bridge, graph):
    """State and diagnostics of a running bridge."""
    state, item = graph.states.get(bridge), f'{bridge} state'
    if state is None:
        findings.add(item, f'no {bridge}/state', warn='check the version of the bridge')
    elif state.startswith('waiting'):
        findings.add(item, state, warn=f'configure and activate {bridge}_node, or remove the '
                     'stated cause')
    else:
        findings.add(item, state, fail='' if state == 'ready' else
                     'remove the cause, then disarm and arm again')
    statuses = graph.of_bridge(bridge)
    for name, status in statuses.items():
        if name not in UNUSED:
            level = {0: OK, 1: WARN}.get(status.level, FAIL)
            findings.append(Finding(f'{bridge} {name}', level, status.message or 'no message',
                                    '' if level == OK else BRIDGES[bridge], status.values))
    if not statuses:
        findings.add(f'{bridge} diagnostics', f'none within {graph.seconds:g} s',
                     warn='increase the time: --seconds 5')


def check_topics(graph: ObservedGraph, gravity: float) -> Findings:
    """Check the sensor topics and what running bridges report; ``gravity`` in m/s^2."""
    findings = Findings()
    for topic, (source, bridge, rate, *ages) in TOPICS.items():
        stream, runs = graph.streams.get(topic, Stream()), bool(bridge) and graph.runs(bridge)
        if bridge and not runs and not stream.publishers and not stream.arrivals:
            findings.add(topic, f'not published: {source} does not run')
        elif not stream.arrivals:
            _absent(findings, topic, source, stream, graph)
        else:
            _rate_of(findings, topic, stream, rate)
            _age_of(findings, topic, stream, *ages)
            _content_of(findings, topic, source, stream, gravity)
        if runs:
            _reports_of(findings, bridge, graph)
    return findings


def _absent(findings, topic, source, stream, graph):
    if stream.publishers:
        findings.add(topic, f"nothing in {graph.seconds:g} s, although "
                     f"{', '.join(stream.publishers)} publishes it", fail='check the sensor, '
                     'multicast and MTU of the network, ROS_AUTOMATIC_DISCOVERY_RANGE')
    elif stream.other_types:
        findings.add(topic, f"published as {', '.join(stream.other_types)}",
                     fail=f'{source} must publish another type: set or remap it')
    else:
        findings.add(topic, f'no publisher in ROS domain {graph.domain}',
                     fail=f'start {source}, remap its topic, set the same ROS_DOMAIN_ID on all '
                     'computers, and ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET')


def _rate_of(findings, topic, stream, nominal):
    pauses = [b - a for a, b in zip(stream.arrivals, stream.arrivals[1:])]
    rate, gap = 1 / fmean(pauses) if sum(pauses) else 0.0, max(pauses, default=0.0)
    findings.grade(
        f'{topic} rate', f'{rate:.1f} Hz, longest pause {1e3 * gap:.0f} ms', rate / nominal,
        f'expected are {nominal:g} Hz: check settings of its driver, network, load',
        warn=RATE if topic in (MOCAP, IMU) else (RATE[0], inf), fail=RATE_FAIL,
        rate_Hz=rate, gap_s=gap, messages=len(stream.arrivals))
    if gap > max(GAP, MISSED / nominal):
        findings.add(f'{topic} pause', f'{1e3 * gap:.0f} ms without a message', gap_s=gap,
                     warn='check network (cable instead of Wi-Fi), load of the computers')


def _age_of(findings, topic, stream, warn, fail):
    freshest, middle, oldest = min(stream.ages), median(stream.ages), max(stream.ages)
    found = (f'{1e3 * freshest:.1f} ms at least, {1e3 * middle:.1f} ms (median), '
             f'{1e3 * oldest:.1f} ms at most')
    remedy = 'check buffers or filters of its driver, network, load'
    if freshest < -AHEAD:
        found += ': stamped in the future'
        remedy = 'clocks are not synchronised: run chrony or PTP on the computers; the driver ' \
            'must stamp with the system clock'
    elif oldest - freshest < CLOCK_SPREAD * freshest:
        remedy = 'nearly the same for all: clocks are not synchronised (run chrony or PTP on ' \
            'the computers), or the stamps are of another clock'
    findings.grade(f'{topic} age', found, freshest, remedy, warn=(-AHEAD, warn),
                   fail=(-AHEAD, fail), freshest_s=freshest, median_s=middle, oldest_s=oldest)


def _content_of(findings, topic, source, stream, gravity):
    if len(stream.publishers) > 1:
        findings.add(f'{topic} publishers', f"{len(stream.publishers)}: "
                     f"{', '.join(sorted(stream.publishers))}", fail='stop all but one (often a '
                     'simulator still runs), or use another ROS_DOMAIN_ID')
    if stream.refused:
        reasons = ', '.join(f'{reason} ({count})' for reason, count in stream.refused.items())
        findings.add(f'{topic} content', f'{stream.refused.total()} of {len(stream.arrivals)} '
                     f'messages cannot be used: {reasons}', fail=f'check {source}')
        return
    if topic in (MOCAP, IMU) and len(stream.norms) > 2 and len(set(stream.norms)) == 1:
        findings.add(f'{topic} content', 'all messages are equal', fail='the sensor has stopped '
                     'or lost the robot, and its driver repeats the last value')
    # The specific force equals gravity at rest.
    if topic == IMU and abs((mean := fmean(stream.norms)) - gravity) > GRAVITY_TOLERANCE:
        findings.add(f'{IMU} specific force', f'{mean:.2f} m/s^2 on average; at rest it must be '
                     f'{gravity:.2f}', warn='its unit is g: the driver must convert to m/s^2'
                     if abs(mean * gravity - gravity) <= GRAVITY_TOLERANCE else
                     'must be specific force in m/s^2 with gravity (REP-145); keep the robot at '
                     'rest', mean_m_s2=mean)


# --- the command --------------------------------------------------------------------------------

PARTS = ('servos', 'board', 'ros')
STYLES = {OK: 'green', WARN: 'yellow', FAIL: 'bold red'}


def run_check(*, listen: Callable[[float], ObservedGraph], servo_port: str | None = None,
              board_port: str | None = None, servo_bus: Path | None = None,
              motor_board: Path | None = None, robot: Path | None = None, seconds: float = 3.0,
              skip: tuple[str, ...] = (), json_path: Path | None = None) -> int:
    """
    Check everything and print a table.

    The arguments are the options of `beetle_omni check`. ``listen`` observes the ROS graph for a
    number of seconds, without ROS it raises ModuleNotFoundError.

    Returns:
        exit status: 0 if nothing failed, else 1.

    Raises:
        ParameterError: unusable input, in one line.
        ModuleNotFoundError: a library of the drivers of an unskipped device.

    """
    for part in skip:
        if part not in PARTS:
            raise ParameterError(f"--skip '{part}': expected {', '.join(PARTS)}")
    console = Console()
    bus, link = ServoBusParameters.load(servo_bus), MotorBoardParameters.load(motor_board)
    robot_parameters = RobotParameters.load(robot)
    bus = replace(bus, port=servo_port or bus.port)
    link = replace(link, port=board_port or link.port)
    graph, found, ros = None, {}, Findings()
    if 'ros' not in skip:
        with console.status(f'listening to ROS for {seconds:g} s'):
            graph = _observed(listen, seconds, ros)
    if 'servos' not in skip:
        from beetle_omni_ros.drivers.device_checks import check_servos  # has driver libraries
        with console.status(f'checking the servos on {bus.port}'):
            found['servos'] = check_servos(bus, robot_parameters.joints, graph)
    if 'board' not in skip:
        from beetle_omni_ros.drivers.device_checks import check_board
        with console.status(f'listening to the motor board on {link.port}'):
            found['board'] = check_board(link, robot_parameters, seconds, graph)
    if 'ros' not in skip:
        found['ros'] = check_topics(graph, robot_parameters.gravity) if graph else ros
    _print(console, found, skip)
    is_ok = all(finding.level != FAIL for rows in found.values() for finding in rows)
    write_json(json_path, {
        'ok': is_ok,
        'findings': [{'part': part, **asdict(finding)} for part, rows in found.items()
                     for finding in rows],
        'meta': {'version': __version__, 'servo_port': bus.port, 'board_port': link.port,
                 'seconds': seconds, 'skipped': list(skip)}})
    return 0 if is_ok else 1


def _observed(listen, seconds, findings):
    """Observe the graph; None, with a finding added, if ROS is missing or does not start."""
    try:
        return listen(seconds)
    except ModuleNotFoundError as error:
        module = (error.name or '').partition('.')[0]
        findings.add('ROS', f"the module '{module}' is not installed",
                     fail='source /opt/ros/jazzy/setup.bash, or --skip ros, or pip install '
                     "'beetle_omni_ros[ros]'")
    except (OSError, RuntimeError) as error:
        findings.add('ROS', f"does not start: {' '.join(str(error).split())}",
                     fail='check RMW_IMPLEMENTATION and network; or --skip ros')
    return None


def _print(console, found, skip):
    table = Table(*(Column(name, overflow='fold') for name in ('item', 'finding', '',
                                                               'what to do')),
                  title='Bring-up', title_justify='left')
    for rows in found.values():
        for finding in rows:
            table.add_row(Text(finding.item), Text(finding.found),
                          Text(finding.level, STYLES[finding.level]), Text(finding.remedy))
        table.add_section()
    console.print(table)
    levels = [finding.level for rows in found.values() for finding in rows]
    failed, warned = levels.count(FAIL), levels.count(WARN)
    skipped = f"; not checked: {', '.join(skip)}" if skip else ''
    console.print(f'{failed} failed, {warned} warnings, {levels.count(OK)} ok{skipped}',
                  highlight=False, style=STYLES[FAIL if failed else WARN if warned else OK])
