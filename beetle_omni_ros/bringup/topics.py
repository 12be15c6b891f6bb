"""Bring-up of what comes through ROS: sensors there, at their rate, of age, by one clock."""

from __future__ import annotations

from statistics import fmean

from beetle_omni_ros.bringup.finding import FAIL, Finding, OK, reported, WARN, worst
from beetle_omni_ros.bringup.heard import Heard, Stream
from beetle_omni_ros.bringup.limits import CheckLimits, TopicLimits

MOCAP, IMU, JOINTS, BATTERY = 'mocap/pose', 'imu/data_raw', 'joint_states', 'battery_state'
# Topic -> name in the limits, whose driver it is, the bridge that publishes it.
TOPICS = {MOCAP: ('mocap', 'the MoCap driver', None), IMU: ('imu', 'the IMU driver', None),
          JOINTS: ('joint', 'joint_bridge_node', 'joint_bridge'),
          BATTERY: ('battery', 'rotor_bridge_node', 'rotor_bridge')}
MISSED = 3              # messages in a row whose absence is a pause
CLOCK_SPREAD = 0.2      # a large age that varies by less than this share of it is a clock's


def check_topics(heard: Heard, limits: CheckLimits, gravity: float,
                 told: frozenset[str] = frozenset()) -> list[Finding]:
    """
    Judge what was heard.

    Args:
        heard: of the graph.
        limits: of what is well.
        gravity: that an IMU at rest shows [m/s^2].
        told: bridges whose reports are judged elsewhere already.

    """
    findings = []
    for topic, (name, source, bridge) in TOPICS.items():
        stream = heard.streams.get(topic, Stream())
        runs = bridge is not None and heard.runs(bridge)
        if bridge and not runs and not stream.publishers and not stream.arrivals:
            findings.append(Finding(topic, OK, f'not published: {source} does not run'))
        else:
            findings += _of_topic(topic, name, source, stream, heard, limits.topics)
        if topic == IMU:
            findings += _of_gravity(stream, gravity, limits.topics)
        if runs and bridge not in told:
            findings += reported(bridge, heard)
    return findings


def _of_topic(topic, name, source, stream: Stream, heard, limits: TopicLimits):
    """Rate, age and usability of one topic."""
    if not stream.arrivals:
        return [_absent(topic, source, stream, heard)]
    findings = [_of_rate(topic, stream, getattr(limits, f'{name}_rate'), limits),
                _of_age(topic, stream, getattr(limits, f'{name}_age'),
                        getattr(limits, f'{name}_age_fail'), limits)]
    if len(stream.publishers) > 1:
        findings.append(Finding(
            f'{topic} publishers', FAIL, f"{len(stream.publishers)}: "
            f"{', '.join(sorted(stream.publishers))}", 'only one may publish it: stop the others '
            '(a simulator?), or use another ROS_DOMAIN_ID'))
    if stream.refused:
        reasons = ', '.join(f'{reason} ({count})' for reason, count in stream.refused.items())
        findings.append(Finding(
            f'{topic} content', FAIL, f'{stream.refused.total()} of {len(stream.arrivals)} '
            f'messages cannot be used: {reasons}', f'look at {source}'))
    elif stream.frozen and topic in (MOCAP, IMU):
        findings.append(Finding(
            f'{topic} content', FAIL, 'every message says the same', 'the sensor has stopped or '
            'lost the robot, and its driver repeats the last value'))
    return findings


def _absent(topic, source, stream, heard):
    where = f'ROS domain {heard.domain}'
    if stream.publishers:
        return Finding(topic, FAIL, f"nothing in {heard.seconds:g} s, although "
                       f"{', '.join(stream.publishers)} publishes it", 'does the sensor deliver? '
                       'Multicast and MTU of the network, BEETLE_OMNI_DISCOVERY')
    if stream.other_types:
        return Finding(topic, FAIL, f"published as {', '.join(stream.other_types)}",
                       f'{source} must publish the type of docs/reference/topics.md: '
                       'set or remap it')
    return Finding(topic, FAIL, f'nobody publishes it in {where}',
                   f'start {source}, remap its topic, same ROS_DOMAIN_ID on all computers, and '
                   'BEETLE_OMNI_DISCOVERY=SUBNET where it runs on another one')


def _of_rate(topic, stream, wanted, limits):
    rate, gap = stream.rate, stream.gap
    found = f'{rate:.1f} Hz, longest pause {1e3 * gap:.0f} ms'
    values = {'rate_Hz': rate, 'gap_s': gap, 'messages': len(stream.arrivals)}
    level, remedy = OK, ''
    if not rate >= limits.rate_low * wanted:
        level = FAIL if not rate >= limits.rate_fail * wanted else WARN
        remedy = f'wanted are {wanted:g} Hz: settings of its driver, network, load'
    elif rate > limits.rate_high * wanted and topic in (MOCAP, IMU):
        level, remedy = WARN, f'wanted are {wanted:g} Hz: set its driver'
    elif gap > max(limits.gap, MISSED / wanted):
        level, remedy = WARN, 'network (cable instead of Wi-Fi), load of the computers'
    return Finding(f'{topic} rate', level, found, remedy, values)


def _of_age(topic, stream, warn, fail, limits):
    freshest, middle, oldest = stream.freshest, stream.median_age, max(stream.ages)
    found = (f'{1e3 * freshest:.1f} ms at least, {1e3 * middle:.1f} ms (median), '
             f'{1e3 * oldest:.1f} ms at most')
    values = {'freshest_s': freshest, 'median_s': middle, 'oldest_s': oldest}
    if freshest < -limits.ahead:
        return Finding(f'{topic} age', FAIL, f'{found}: stamped in the future', 'clocks are not '
                       'synchronised: chrony or PTP between the computers; it must stamp with '
                       'the system clock', values)
    if freshest <= warn:
        return Finding(f'{topic} age', OK, found, values=values)
    level = worst([WARN, FAIL if freshest > fail else OK])
    steady = oldest - freshest < CLOCK_SPREAD * freshest
    remedy = 'nearly the same for all: clocks are not synchronised (chrony or PTP between the ' \
        'computers), or stamps of another clock' if steady else \
        'buffers or filters of its driver, network, load'
    return Finding(f'{topic} age', level, found, remedy, values)


def _of_gravity(stream, gravity, limits):
    """Units of the IMU: at rest it shows gravity."""
    if len(stream.sizes) < 2 or stream.refused:
        return []
    mean = fmean(stream.sizes)
    if abs(mean - gravity) <= limits.gravity_tolerance:
        return []
    remedy = 'its unit is g: the driver must convert to m/s^2' \
        if abs(mean * gravity - gravity) <= limits.gravity_tolerance else \
        'specific force in m/s^2 with gravity in it (REP-145); is the robot at rest?'
    return [Finding(f'{IMU} specific force', WARN, f'{mean:.2f} m/s^2 on average, at rest it '
                    f'is {gravity:.2f}', remedy, {'mean_m_s2': mean})]
