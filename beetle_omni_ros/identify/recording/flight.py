"""From a recording to a checked flight, or the reason why it is unusable."""

from dataclasses import replace
from filecmp import cmp
from functools import partial
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import bag_files
from beetle_omni_ros.identify.recording.bag import (
    changed,
    COMMAND,
    Damage,
    IMU,
    NEEDED,
    POSE,
    Recording,
)
from beetle_omni_ros.identify.recording.check import checked
from beetle_omni_ros.identify.recording.parameters import GapParameters, shipped
from beetle_omni_ros.identify.recording.relations import series_of, THRUSTS
from beetle_omni_ros.identify.recording.series import aligned
from beetle_omni_ros.identify.recording.topics import begin_of
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

LEAST = 50     # messages of a topic
TABLES = ('.csv', '.gz')     # endings of files that are no bags


def flown(recording: Recording, robot: RobotParameters,
          p: GapParameters) -> tuple[Recording, float] | None:
    """
    The longest flight of a recording; None if the robot does not fly.

    Times of recording are used if they are known, because stamps and units may be damaged.

    Returns:
        the flight, with up to ``p.memory`` before it, and that time [s].

    """
    clock = {topic: recording.received.get(topic, t) for topic, t in recording.times.items()}
    t, thrust = clock[COMMAND], recording.values[COMMAND][:, 4:].sum(axis=1)
    weight = robot.mass * robot.gravity
    level = max((thrust**2).sum() / max(thrust.sum(), 1e-9) / weight, 1e-9)
    unit = min((1.0, *THRUSTS), key=lambda u: abs(np.log(level / u)))
    lifted = np.flatnonzero(thrust > p.lifted * weight * min(unit, level))
    if not len(lifted):
        return None
    # A short dip of the thrust is a descent.
    landed = (np.diff(lifted) > 1) & (np.diff(t[lifted]) > p.settle)
    pieces = np.split(lifted, np.flatnonzero(landed) + 1)
    begin, end = t[max(pieces, key=lambda rows: t[rows[-1]] - t[rows[0]])][[0, -1]]
    begin, end = _aloft(recording, clock[POSE], begin, end, p)
    first = max(begin - p.memory, t[0])
    if len(pieces) > 1:
        recording = replace(recording, findings=[
            *recording.findings, f'{recording.name}: {len(pieces)} flights, the longest is used'])
    for topic, at in clock.items():
        recording = changed(recording, topic, keep=(at >= first) & (at <= end))
    return recording, float(begin - first)


def _aloft(recording, when, begin, end, p):
    """Times after take-off and before touchdown, as far as these were recorded."""
    height, inside = recording.values[POSE][:, 2], (when > begin) & (when < end)
    before, after = (height[rows] for rows in (when < begin - shipped().bin,
                                               when > end + shipped().bin))
    if len(after):
        high = when[inside & (height > after[0] + shipped().risen)]
        end = high[-1] if len(high) else end
    if not len(before):
        return begin, end
    high = when[inside & (height > before[-1] + shipped().risen)]
    begin = (high[0] if len(high) else begin) + p.settle
    flying = [at for at, state in recording.states if state.startswith('flying') and at < end]
    return max([begin, *flying[:1]]), end


class UnusableFlight(ValueError):
    """
    A recording cannot be used; the text states the first of its ``problems`` in one line.

    Attributes:
        problems: the detected damages.

    """

    def __init__(self, *problems: Damage):
        super().__init__(problems[0].text)
        self.problems = problems


def prepare(recording: Recording, robot: RobotParameters, p: GapParameters,
            fix: bool = False) -> Recording:
    """
    Check a recording and select the flight.

    With ``fix``, certain corrections are applied to the data.

    Raises:
        UnusableFlight: with name and damages of the recording.

    """
    name = recording.name
    counts = {topic: len(recording.times[topic]) for topic in NEEDED}
    if few := [Damage(name, topic, f'missing or nearly empty: {count} messages')
               for topic, count in counts.items() if count < LEAST]:
        raise UnusableFlight(*few)
    part = flown(recording, robot, p)
    if part is None:
        raise UnusableFlight(Damage(name, COMMAND, 'the robot does not fly: commanded thrust is '
                                    f'never above {p.lifted:g} of its weight'))
    origin = begin_of(recording)
    recording, lead = part
    recording, done, wrong = checked(recording, robot, origin, fix)
    if wrong:
        raise UnusableFlight(*wrong)
    findings = [*recording.findings, *done]
    series = {topic: _in_order(name, topic, recording, findings) for topic in recording.times}
    begin, end = _without_gaps(name, series, lead, p, findings, origin)
    if end - begin < p.least_duration:
        raise UnusableFlight(Damage(name, 'all topics', f'{max(end - begin, 0.0):.1f} s of usable '
                                    f'flight, {p.least_duration:.3g} s are needed'))
    times, values = {}, {}
    for topic, (t, rows) in series.items():
        keep = (t > begin - 1.0) & (t < end + 0.5)
        times[topic], values[topic] = t[keep] - begin, rows[keep]
    pose = values[POSE]
    norm = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    if abs(np.median(norm) - 1) > 0.01:
        findings.append(f'{name}: {POSE}: orientations of norm {np.median(norm):.3g}, '
                        'expected unit quaternions; normalised')
    pose[:, 3:] = aligned(pose[:, 3:] / np.where(norm > 1e-6, norm, 1.0))
    _check_robot(name, values, robot, p)
    return Recording(name, times, values, findings=findings, start=begin, duration=end - begin)


def _in_order(name, topic, recording, findings):
    """Series of a topic; what it lacks of the recorded messages is a finding."""
    recorded = recording.times[topic]
    fine = np.isfinite(recorded) & np.isfinite(recording.values[topic]).all(axis=1)
    if not fine.all():
        findings.append(f'{name}: {topic}: {int((~fine).sum())} messages hold no numbers')
    if back := int((np.diff(recorded[fine]) < 0).sum()):
        findings.append(f'{name}: {topic}: {back} messages are out of order; sorted by stamp')
    t, values = series_of(recording, topic)
    if (lost := int(fine.sum()) - len(t)) > 2:
        findings.append(f'{name}: {topic}: {lost} stamps occur twice')
    return t, values


def _without_gaps(name, series, lead, p, findings, origin):
    """The longest piece without a long gap in any topic, from ``lead`` [s] after its begin on."""
    breaks, lost, longest = [], 0.0, (0.0, '', 0.0)
    begin = max(series[COMMAND][0][0] + lead, *(series[topic][0][0] for topic in NEEDED))
    end = min(series[topic][0][-1] for topic in NEEDED)
    for topic in NEEDED:
        t = series[topic][0]
        inside = t[(t >= begin) & (t <= end)]
        for k in np.flatnonzero(np.diff(inside) > p.longest_gap):
            breaks.append((inside[k], inside[k + 1]))
            silence, at_s = inside[k + 1] - inside[k], inside[k] - origin
            lost, longest = lost + silence, max(longest, (silence, topic, at_s))
            findings.append(f'{name}: {topic}: silent for {silence:.2f} s, from {at_s:.1f} s on')
    if lost > p.most_lost * max(end - begin, 1e-9) and lost > 1.0:
        silence, topic, at_s = longest
        raise UnusableFlight(Damage(name, topic, f'silent for {silence:.2f} s; {lost:.1f} s of '
                                    f'{end - begin:.1f} s of flight are missing', at_s))
    edges = [begin, *(x for gap in sorted(breaks) for x in gap), end]
    pieces = [(edges[k], edges[k + 1]) for k in range(0, len(edges), 2)]
    return max(pieces, key=lambda piece: piece[1] - piece[0])


def _check_robot(name, values, robot, p):
    """Refuse a flight of a completely different robot."""
    total = np.median(np.linalg.norm(values[IMU][:, :3], axis=1))
    if total < 0.3 * robot.gravity:
        raise UnusableFlight(Damage(name, IMU, f'specific force is {total:.2f} m/s^2, near '
                                    f'{robot.gravity:.2f} m/s^2 expected'))
    commanded = np.median(values[COMMAND][:, 4:].sum(axis=1)) / robot.mass
    # Thrusts may partly cancel each other, so only too small a sum is impossible.
    if commanded < (1 - p.wrong_robot) * total or commanded > 3 * total:
        raise UnusableFlight(Damage(
            name, COMMAND, 'the robot file does not fit: commanded thrust over its mass is '
            f'{commanded:.1f} m/s^2, the IMU measures {total:.1f} m/s^2'))


def check_apart(runs: list[Path]) -> None:
    """
    Refuse a recording that is given twice, even under different names.

    A flight that is both fitted and held out would confirm any fit.

    Raises:
        BagError: no recording at a path.
        ParameterError: the same recording twice, with both paths.

    """
    known: list[tuple[Path, list[Path]]] = []
    for run in runs:
        files = [run] if run.suffix.lower() in TABLES else bag_files(run)
        if not all(file.is_file() for file in files):
            continue        # reading it raises the error
        for other, own in known:
            if len(own) == len(files) and all(map(partial(cmp, shallow=False), own, files)):
                raise ParameterError(f'{other} and {run}: the same recording twice; '
                                     'expected different flights, each once')
        known.append((run, files))


def check_flights(runs: list[Path], flights: list[Recording], same: float) -> None:
    """
    Refuse one flight in two different files: cut, converted or recorded twice.

    Two flights are the same from this share of equal IMU readings.

    Raises:
        ParameterError: with both paths.

    """
    readings = [{row.tobytes() for row in flight.values[IMU]} for flight in flights]
    for k, own in enumerate(readings):
        for j in range(k):
            if len(own & readings[j]) > same * min(len(own), len(readings[j])):
                raise ParameterError(f'{runs[j]} and {runs[k]}: the same flight in two '
                                     'recordings; expected different flights, each once')
