"""Check of the sensor topics in ROS: publishers, rates, ages and clocks."""

from statistics import fmean

from beetle_omni_ros.bringup.finding import FAIL, Finding, OK, reported, WARN
from beetle_omni_ros.bringup.graph import ObservedGraph, Stream
from beetle_omni_ros.bringup.limits import CheckLimits, TopicLimits

MOCAP, IMU, JOINTS, BATTERY = 'mocap/pose', 'imu/data_raw', 'joint_states', 'battery_state'
# Topic -> name in the limits, publisher in words, bridge that publishes it.
TOPICS = {MOCAP: ('mocap', 'the MoCap driver', None), IMU: ('imu', 'the IMU driver', None),
          JOINTS: ('joint', 'joint_bridge_node', 'joint_bridge'),
          BATTERY: ('battery', 'rotor_bridge_node', 'rotor_bridge')}
MISSED = 3              # missing messages in a row that count as a pause
CLOCK_SPREAD = 0.2      # relative spread of large ages below which clocks are the cause


def check_topics(graph: ObservedGraph, limits: CheckLimits, gravity: float,
                 reported_bridges: frozenset[str] = frozenset()) -> list[Finding]:
    """
    Check rates, ages and contents of the sensor topics; ``gravity`` in m/s^2.

    Reports of a running bridge are added unless it is in ``reported_bridges``.
    """
    findings = []
    for topic, (name, source, bridge) in TOPICS.items():
        stream = graph.streams.get(topic, Stream())
        runs = bridge is not None and graph.runs(bridge)
        if bridge and not runs and not stream.publishers and not stream.arrivals:
            findings.append(Finding(topic, OK, f'not published: {source} does not run'))
        else:
            findings += _of_topic(topic, name, source, stream, graph, limits.topics)
        if topic == IMU:
            findings += _of_gravity(stream, gravity, limits.topics)
        if runs and bridge not in reported_bridges:
            findings += reported(bridge, graph)
    return findings


def _of_topic(topic, name, source, stream: Stream, graph, limits: TopicLimits):
    if not stream.arrivals:
        return [_absent(topic, source, stream, graph)]
    findings = [_of_rate(topic, stream, getattr(limits, f'{name}_rate'), limits),
                _of_age(topic, stream, getattr(limits, f'{name}_age'),
                        getattr(limits, f'{name}_age_fail'), limits)]
    if len(stream.publishers) > 1:
        findings.append(Finding(
            f'{topic} publishers', FAIL, f"{len(stream.publishers)}: "
            f"{', '.join(sorted(stream.publishers))}", 'stop all but one (often a '
            'simulator still runs), or use another ROS_DOMAIN_ID'))
    if stream.refused:
        reasons = ', '.join(f'{reason} ({count})' for reason, count in stream.refused.items())
        findings.append(Finding(
            f'{topic} content', FAIL, f'{stream.refused.total()} of {len(stream.arrivals)} '
            f'messages cannot be used: {reasons}', f'check {source}'))
    elif stream.frozen and topic in (MOCAP, IMU):
        findings.append(Finding(
            f'{topic} content', FAIL, 'all messages are equal', 'the sensor has stopped or '
            'lost the robot, and its driver repeats the last value'))
    return findings


def _absent(topic, source, stream, graph):
    if stream.publishers:
        return Finding(topic, FAIL, f"nothing in {graph.seconds:g} s, although "
                       f"{', '.join(stream.publishers)} publishes it", 'check the sensor, '
                       'multicast and MTU of the network, BEETLE_OMNI_DISCOVERY')
    if stream.other_types:
        return Finding(topic, FAIL, f"published as {', '.join(stream.other_types)}",
                       f'{source} must publish another type: set or remap it')
    return Finding(topic, FAIL, f'no publisher in ROS domain {graph.domain}',
                   f'start {source}, remap its topic, set the same ROS_DOMAIN_ID on all '
                   'computers, and BEETLE_OMNI_DISCOVERY=SUBNET if it runs on another one')


def _of_rate(topic, stream, nominal, limits):
    rate, gap = stream.rate, stream.gap
    found = f'{rate:.1f} Hz, longest pause {1e3 * gap:.0f} ms'
    values = {'rate_Hz': rate, 'gap_s': gap, 'messages': len(stream.arrivals)}
    level, remedy = OK, ''
    if not rate >= limits.rate_low * nominal:
        level = FAIL if not rate >= limits.rate_fail * nominal else WARN
        remedy = f'expected are {nominal:g} Hz: check settings of its driver, network, load'
    elif rate > limits.rate_high * nominal and topic in (MOCAP, IMU):
        level, remedy = WARN, f'expected are {nominal:g} Hz: set its driver'
    elif gap > max(limits.gap, MISSED / nominal):
        level, remedy = WARN, 'check network (cable instead of Wi-Fi), load of the computers'
    return Finding(f'{topic} rate', level, found, remedy, values)


def _of_age(topic, stream, warn, fail, limits):
    freshest, median, oldest = stream.freshest, stream.median_age, max(stream.ages)
    found = (f'{1e3 * freshest:.1f} ms at least, {1e3 * median:.1f} ms (median), '
             f'{1e3 * oldest:.1f} ms at most')
    values = {'freshest_s': freshest, 'median_s': median, 'oldest_s': oldest}
    if freshest < -limits.ahead:
        return Finding(f'{topic} age', FAIL, f'{found}: stamped in the future', 'clocks are not '
                       'synchronised: run chrony or PTP on the computers; the driver must '
                       'stamp with the system clock', values)
    if freshest <= warn:
        return Finding(f'{topic} age', OK, found, values=values)
    level = FAIL if freshest > fail else WARN
    steady = oldest - freshest < CLOCK_SPREAD * freshest
    remedy = 'nearly the same for all: clocks are not synchronised (run chrony or PTP on the ' \
        'computers), or the stamps are of another clock' if steady else \
        'check buffers or filters of its driver, network, load'
    return Finding(f'{topic} age', level, found, remedy, values)


def _of_gravity(stream, gravity, limits):
    """Finding about the unit of the specific force, which equals gravity at rest."""
    if len(stream.norms) < 2 or stream.refused:
        return []
    mean = fmean(stream.norms)
    if abs(mean - gravity) <= limits.gravity_tolerance:
        return []
    remedy = 'its unit is g: the driver must convert to m/s^2' \
        if abs(mean * gravity - gravity) <= limits.gravity_tolerance else \
        'must be specific force in m/s^2 with gravity (REP-145); keep the robot at rest'
    return [Finding(f'{IMU} specific force', WARN, f'{mean:.2f} m/s^2 on average; at rest '
                    f'it must be {gravity:.2f}', remedy, {'mean_m_s2': mean})]
