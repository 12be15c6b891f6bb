"""Findings of `beetle_omni check`, its limits, and what was observed in the ROS graph."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from statistics import fmean, median

from beetle_omni_ros.robot.schema import parameter, ParameterFile

OK, WARN, FAIL = 'ok', 'warn', 'fail'
# Bridge -> device whose port it opens, page about its faults.
BRIDGES = {'joint_bridge': 'the servo bus', 'rotor_bridge': 'the motor board'}
FAULT_PAGES = {'joint_bridge': 'docs/reference/hardware_faults.md: what happens when',
               'rotor_bridge': 'docs/reference/firmware.md: outcome of faults'}
UNUSED = ('node', 'inputs', 'compute')      # statuses of every node; the topics cover them
MOCAP, IMU, JOINTS, BATTERY = 'mocap/pose', 'imu/data_raw', 'joint_states', 'battery_state'
# Topic -> name in the limits, publisher in words, bridge that publishes it.
TOPICS = {MOCAP: ('mocap', 'the MoCap driver', None), IMU: ('imu', 'the IMU driver', None),
          JOINTS: ('joint', 'joint_bridge_node', 'joint_bridge'),
          BATTERY: ('battery', 'rotor_bridge_node', 'rotor_bridge')}
MISSED = 3              # missing messages in a row that count as a pause
CLOCK_SPREAD = 0.2      # relative spread of large ages below which clocks are the cause


@dataclass(frozen=True, slots=True)
class Finding:
    """
    One row of the result.

    Attributes:
        item: name of the checked item, stable for scripts.
        level: 'ok', 'warn' (the robot can fly, but look at the item) or 'fail'.
        found: description with numbers and units.
        remedy: what to do; '' for level 'ok'.
        values: numbers behind ``found``; each key ends with the unit.

    """

    item: str
    level: str
    found: str
    remedy: str = ''
    values: Mapping[str, float | int | str | None] = field(default_factory=dict)


class Findings(list[Finding]):
    """Findings in the order of the checks."""

    def add(self, item: str, found: str, *, fail: str = '', warn: str = '',
            **values: float | int | str | None) -> None:
        """Add a finding; the remedy ``fail`` or ``warn`` determines its level, none is 'ok'."""
        level = FAIL if fail else WARN if warn else OK
        self.append(Finding(item, level, found, fail or warn, values))

    def grade(self, item: str, found: str, value: float, remedy: str, *, warn: float,
              fail: float, **values) -> None:
        """Add a finding about ``value``: 'warn' above ``warn``, 'fail' above ``fail`` or NaN."""
        self.add(item, found, fail=remedy if not value <= fail else '',
                 warn=remedy if value > warn else '', **values)

    def missing(self, item: str, error: ModuleNotFoundError, extra: str, remedy: str = '') -> None:
        """Add a finding about an item that needs a library of the pip extra ``extra``."""
        module = (error.name or '').partition('.')[0]
        self.add(item, f"not checked: the module '{module}' is not installed",
                 fail=f"{remedy}pip install 'beetle_omni_ros[{extra}]'")


# --- limits -------------------------------------------------------------------------------------

_share = partial(parameter, low=0, high=1)
_supply = partial(parameter, unit='V', low=0, high=60)


def _rate(topic, low, high):
    return parameter(doc=f'nominal rate of {topic}', unit='Hz', low=low, high=high)


def _age(topic, result):
    return parameter(doc=f'age of the freshest message of {topic}; {result} above', unit='s',
                     low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Limits for each servo and for the bus."""

    supply_fail_low: float = _supply(doc='supply voltage of a servo; failure below')
    supply_low: float = _supply(doc='supply voltage of a servo; warning below')
    supply_high: float = _supply(doc='supply voltage of a servo; failure above')
    temperature_high: float = parameter(doc='temperature of a servo; warning above', unit='C',
                                        low=0, high=150)
    answer_loss: float = _share(doc='share of missing answers; warning above')
    answer_loss_fail: float = _share(doc='share of missing answers; failure above')


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage limits of a cell at rest."""

    cell_fail_low: float = parameter(doc='cell voltage; failure below', unit='V', low=0, high=5)
    cell_low: float = parameter(doc='cell voltage; warning below', unit='V', low=0, high=5)
    cell_high: float = parameter(doc='cell voltage; failure above', unit='V', low=0, high=6)


@dataclass(frozen=True, kw_only=True)
class LinkLimits:
    """Limits for serial ports."""

    loss: float = _share(doc='share of lost or corrupt packets; warning above')
    loss_fail: float = _share(doc='share of lost or corrupt packets; failure above')
    latency_timer: int = parameter(doc='latency timer of an FTDI adapter; failure above',
                                   unit='ms', low=1, high=255)


@dataclass(frozen=True, kw_only=True)
class TopicLimits:
    """Limits for the rates and ages of ROS topics."""

    mocap_rate: float = _rate(MOCAP, 1, 2000)
    imu_rate: float = _rate(IMU, 1, 8000)
    joint_rate: float = _rate(JOINTS, 1, 2000)
    battery_rate: float = _rate(BATTERY, 0.1, 1000)
    rate_low: float = _share(doc='share of the nominal rate; warning below')
    rate_fail: float = _share(doc='share of the nominal rate; failure below')
    rate_high: float = parameter(doc='multiple of the nominal rate; warning above', low=1,
                                 high=100)
    ahead: float = parameter(doc='lead of a stamp over the clock of this computer; failure above',
                             unit='s', low=0, high=10)
    mocap_age: float = _age(MOCAP, 'warning')
    mocap_age_fail: float = _age(MOCAP, 'failure')
    imu_age: float = _age(IMU, 'warning')
    imu_age_fail: float = _age(IMU, 'failure')
    joint_age: float = _age(JOINTS, 'warning')
    joint_age_fail: float = _age(JOINTS, 'failure')
    battery_age: float = _age(BATTERY, 'warning')
    battery_age_fail: float = _age(BATTERY, 'failure')
    gap: float = parameter(doc='pause between two messages; warning above', unit='s', low=0,
                           high=10)
    gravity_tolerance: float = parameter(
        doc='difference between mean specific force at rest and gravity; warning above',
        unit='m/s^2', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class CheckLimits(ParameterFile, file='check.yaml'):
    """All limits of params/check.yaml."""

    servos: ServoLimits = parameter(doc='servos')
    battery: BatteryLimits = parameter(doc='battery')
    link: LinkLimits = parameter(doc='serial ports')
    topics: TopicLimits = parameter(doc='topics')


# --- the observed graph -------------------------------------------------------------------------

@dataclass
class Stream:
    """
    Messages of one topic.

    Attributes:
        arrivals: arrival times on a monotonic clock [s].
        ages: clock of this computer minus stamp, at arrival [s]; the smallest is the latency plus
            the offset between the clocks.
        norms: norm of the measured vector of each message, equal only if a sensor is frozen.
        refused: reason -> number of unusable messages.
        publishers: names of the publishing nodes.
        other_types: other message types under which the topic is published.

    """

    arrivals: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    norms: list[float] = field(default_factory=list)
    refused: Counter = field(default_factory=Counter)
    publishers: list[str] = field(default_factory=list)
    other_types: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Status:
    """A diagnostic status; ``level`` is 0 (ok), 1 (warning), 2 (error) or 3 (stale)."""

    level: int
    message: str
    values: dict[str, str]


@dataclass
class ObservedGraph:
    """
    Everything observed during one check.

    Attributes:
        domain: ROS domain.
        seconds: duration of the observation [s].
        streams: topic -> its messages.
        states: bridge ('joint_bridge', 'rotor_bridge') -> its latched state.
        diagnostics: name of a status -> the newest one.

    """

    domain: int = 0
    seconds: float = 0.0
    streams: dict[str, Stream] = field(default_factory=dict)
    states: dict[str, str] = field(default_factory=dict)
    diagnostics: dict[str, Status] = field(default_factory=dict)

    def of_bridge(self, bridge: str) -> dict[str, Status]:
        """Diagnostics of a bridge's node: name without the prefix 'NODE: ' -> status."""
        start = f'{bridge}_node: '
        return {name.removeprefix(start): status for name, status in self.diagnostics.items()
                if name.startswith(start)}

    def runs(self, bridge: str) -> bool:
        """Whether a state or a diagnostic of the bridge arrived."""
        return bridge in self.states or bool(self.of_bridge(bridge))


def closed_port(item: str, found: str, remedy: str, bridge: str, graph: ObservedGraph | None
                ) -> Findings:
    """Findings about a device whose port cannot be opened: the reports of a running bridge."""
    findings = Findings()
    if graph and graph.runs(bridge) and 'another process' in found:
        findings.add(item, f'{found}; not opened, judged by what {bridge}_node reports about '
                     f'{BRIDGES[bridge]}')
        findings += reported(bridge, graph)
    else:
        findings.add(item, found, fail=remedy)
    return findings


def reported(bridge: str, graph: ObservedGraph) -> Findings:
    """State and diagnostics of a running bridge as findings."""
    findings, state = Findings(), graph.states.get(bridge)
    item = f'{bridge} state'
    if state is None:
        findings.add(item, f'no {bridge}/state', warn='check the version of the bridge')
    elif state.startswith('waiting'):
        findings.add(item, state, warn=f'configure and activate {bridge}_node, or remove the '
                     'stated cause')
    else:
        findings.add(item, state, fail='' if state == 'ready' else
                     'remove the cause, then disarm and arm again')
    for name, status in graph.of_bridge(bridge).items():
        if name not in UNUSED:
            level = {0: OK, 1: WARN}.get(status.level, FAIL)
            findings.append(Finding(f'{bridge} {name}', level, status.message or 'no message',
                                    '' if level == OK else FAULT_PAGES[bridge], status.values))
    if len(findings) == 1:
        findings.add(f'{bridge} diagnostics', f'none within {graph.seconds:g} s',
                     warn='increase the time: --seconds 5')
    return findings


def check_topics(graph: ObservedGraph, limits: CheckLimits, gravity: float,
                 reported_bridges: frozenset[str] = frozenset()) -> Findings:
    """
    Check rates, ages and contents of the sensor topics; ``gravity`` in m/s^2.

    Reports of a running bridge are added unless it is in ``reported_bridges``.
    """
    findings = Findings()
    for topic, (name, source, bridge) in TOPICS.items():
        stream = graph.streams.get(topic, Stream())
        runs = bridge is not None and graph.runs(bridge)
        if bridge and not runs and not stream.publishers and not stream.arrivals:
            findings.add(topic, f'not published: {source} does not run')
        elif not stream.arrivals:
            _absent(findings, topic, source, stream, graph)
        else:
            _rate_of(findings, topic, stream, getattr(limits.topics, f'{name}_rate'),
                     limits.topics)
            _age_of(findings, topic, stream, getattr(limits.topics, f'{name}_age'),
                    getattr(limits.topics, f'{name}_age_fail'), limits.topics)
            _content_of(findings, topic, source, stream)
        if topic == IMU:
            _gravity_of(findings, stream, gravity, limits.topics)
        if runs and bridge not in reported_bridges:
            findings += reported(bridge, graph)
    return findings


def _absent(findings, topic, source, stream, graph):
    if stream.publishers:
        findings.add(topic, f"nothing in {graph.seconds:g} s, although "
                     f"{', '.join(stream.publishers)} publishes it", fail='check the sensor, '
                     'multicast and MTU of the network, BEETLE_OMNI_DISCOVERY')
    elif stream.other_types:
        findings.add(topic, f"published as {', '.join(stream.other_types)}",
                     fail=f'{source} must publish the type of docs/reference/topics.md: '
                     'set or remap it')
    else:
        findings.add(topic, f'no publisher in ROS domain {graph.domain}',
                     fail=f'start {source}, remap its topic, set the same ROS_DOMAIN_ID on all '
                     'computers, and BEETLE_OMNI_DISCOVERY=SUBNET if it runs on another one')


def _rate_of(findings, topic, stream, nominal, limits):
    pauses = [b - a for a, b in zip(stream.arrivals, stream.arrivals[1:])]
    rate, gap = 1 / fmean(pauses) if sum(pauses) else 0.0, max(pauses, default=0.0)
    low = rate < limits.rate_low * nominal
    slow = f'expected are {nominal:g} Hz: check settings of its driver, network, load'
    fast = f'expected are {nominal:g} Hz: set its driver'
    findings.add(
        f'{topic} rate', f'{rate:.1f} Hz, longest pause {1e3 * gap:.0f} ms',
        fail=slow if rate < limits.rate_fail * nominal else '',
        warn=slow if low else fast if rate > limits.rate_high * nominal and topic in (MOCAP, IMU)
        else 'check network (cable instead of Wi-Fi), load of the computers'
        if gap > max(limits.gap, MISSED / nominal) else '',
        rate_Hz=rate, gap_s=gap, messages=len(stream.arrivals))


def _age_of(findings, topic, stream, warn, fail, limits):
    freshest, middle, oldest = min(stream.ages), median(stream.ages), max(stream.ages)
    found = (f'{1e3 * freshest:.1f} ms at least, {1e3 * middle:.1f} ms (median), '
             f'{1e3 * oldest:.1f} ms at most')
    values = {'freshest_s': freshest, 'median_s': middle, 'oldest_s': oldest}
    if freshest < -limits.ahead:
        findings.add(f'{topic} age', f'{found}: stamped in the future', fail='clocks are not '
                     'synchronised: run chrony or PTP on the computers; the driver must '
                     'stamp with the system clock', **values)
        return
    remedy = 'nearly the same for all: clocks are not synchronised (run chrony or PTP on the ' \
        'computers), or the stamps are of another clock' \
        if oldest - freshest < CLOCK_SPREAD * freshest else \
        'check buffers or filters of its driver, network, load'
    findings.grade(f'{topic} age', found, freshest, remedy, warn=warn, fail=fail, **values)


def _content_of(findings, topic, source, stream):
    if len(stream.publishers) > 1:
        findings.add(f'{topic} publishers', f"{len(stream.publishers)}: "
                     f"{', '.join(sorted(stream.publishers))}", fail='stop all but one (often a '
                     'simulator still runs), or use another ROS_DOMAIN_ID')
    if stream.refused:
        reasons = ', '.join(f'{reason} ({count})' for reason, count in stream.refused.items())
        findings.add(f'{topic} content', f'{stream.refused.total()} of {len(stream.arrivals)} '
                     f'messages cannot be used: {reasons}', fail=f'check {source}')
    elif topic in (MOCAP, IMU) and len(stream.norms) > 2 and len(set(stream.norms)) == 1:
        findings.add(f'{topic} content', 'all messages are equal', fail='the sensor has stopped '
                     'or lost the robot, and its driver repeats the last value')


def _gravity_of(findings, stream, gravity, limits):
    """Check the unit of the specific force, which equals gravity at rest."""
    if len(stream.norms) < 2 or stream.refused:
        return
    mean = fmean(stream.norms)
    if abs(mean - gravity) > limits.gravity_tolerance:
        findings.add(f'{IMU} specific force', f'{mean:.2f} m/s^2 on average; at rest it must be '
                     f'{gravity:.2f}', warn='its unit is g: the driver must convert to m/s^2'
                     if abs(mean * gravity - gravity) <= limits.gravity_tolerance else
                     'must be specific force in m/s^2 with gravity (REP-145); keep the robot at '
                     'rest', mean_m_s2=mean)
