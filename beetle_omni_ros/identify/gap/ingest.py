"""From a recording to a checked flight, or the reason why it is unusable."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import hashlib
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid

from beetle_omni_ros.bags.bag import bag_files
from beetle_omni_ros.identify.gap.bags import NEEDED, read_recording, Recording
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.series import aligned
from beetle_omni_ros.identify.recording.check import checked
from beetle_omni_ros.identify.recording.clocks import begin_of
from beetle_omni_ros.identify.recording.damage import changed, Damage
from beetle_omni_ros.identify.recording.flown import flown
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

TABLES = ('.csv', '.gz')     # endings of files that are no bags


class UnusableFlight(ValueError):
    """
    A recording cannot be used; the text states the reason in one line.

    Attributes:
        problems: the detected damages.

    """

    def __init__(self, text: str, problems: Sequence[Damage] = ()):
        super().__init__(text)
        self.problems = list(problems)


@dataclass
class Flight:
    """
    One contiguous piece of flight.

    Attributes:
        name: name of the recording.
        start: stamp of its beginning [s]; all times below are relative to it.
        duration: duration [s].
        imu_t, imu: (N,) and (N, 6) specific force [m/s^2], rates [rad/s].
        pose_t, pose: (N,) and (N, 7) position [m] and quaternion xyzw, sign-continuous.
        joint_t, joint: (N,) and (N, 4) [rad].
        command_t, command: (N,) and (N, 8) [rad], [N].
        battery_t, battery: (N,) and (N, 2) voltage [V] and charge drawn since the first
            message [A h], zero if no current is known; possibly empty.
        findings: remarks of the checks.

    """

    name: str
    start: float
    duration: float
    imu_t: np.ndarray
    imu: np.ndarray
    pose_t: np.ndarray
    pose: np.ndarray
    joint_t: np.ndarray
    joint: np.ndarray
    command_t: np.ndarray
    command: np.ndarray
    battery_t: np.ndarray
    battery: np.ndarray
    findings: list[str] = field(default_factory=list)


def load_flight(path: str | Path, robot: RobotParameters, p: GapParameters,
                fix: bool = False, name: str = '') -> Flight:
    """
    Read and check one recording.

    With ``fix``, certain corrections are applied to the data. ``name`` replaces the folder's name
    in messages.

    Raises:
        BagError: no such bag, or no recording of this robot.
        UnusableFlight: with name and damages of the recording.

    """
    recording = read_recording(path)
    recording.name = name or recording.name
    return prepare(recording, robot, p, fix)


def prepare(recording: Recording, robot: RobotParameters, p: GapParameters,
            fix: bool = False) -> Flight:
    """
    Check a recording and select the flight; see :func:`load_flight`.

    Raises:
        UnusableFlight: with name and damages of the recording.

    """
    name = recording.name
    missing = [topic for topic in NEEDED if len(recording.times[topic]) < 50]
    if missing:
        counts = ', '.join(f'{topic} ({len(recording.times[topic])} messages)'
                           for topic in missing)
        raise UnusableFlight(f'{name}: missing or nearly empty: {counts}', [
            Damage(name, topic, f'{len(recording.times[topic])} messages') for topic in missing])
    part = flown(_with_charge(recording), robot, p)
    if part is None:
        raise _unusable(name, 'command', 'the robot does not fly: commanded thrust is never above '
                        f'{p.lifted:g} of its weight')
    origin = begin_of(recording)
    recording, lead = part
    recording, done, wrong = checked(recording, robot, origin, fix)
    findings = [*recording.warnings, *done]
    if wrong:
        raise UnusableFlight(wrong[0].text, wrong)
    series = {topic: _in_order(name, topic, recording, findings) for topic in recording.times}
    t = series['command'][0]
    begin, end = t[0] + lead, t[-1]
    begin, end = _without_gaps(name, series, begin, end, p, findings, origin)
    if end - begin < p.least_duration:
        raise _unusable(name, 'all topics', f'{max(end - begin, 0.0):.1f} s of usable flight, '
                        f'{p.least_duration:.3g} s are needed')
    cut = {}
    for topic, (t, values) in series.items():
        keep = (t > begin - 1.0) & (t < end + 0.5)
        cut[topic] = t[keep] - begin, values[keep]
    pose = cut['mocap/pose'][1].copy()
    norm = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    if abs(np.median(norm) - 1) > 0.01:
        findings.append(f'{name}: mocap/pose: orientations of norm {np.median(norm):.3g}, '
                        'expected unit quaternions; normalised')
    pose[:, 3:] = aligned(pose[:, 3:] / np.where(norm > 1e-6, norm, 1.0))
    flight = Flight(name, begin, end - begin, *cut['imu/data_raw'], cut['mocap/pose'][0], pose,
                    *cut['joint_states'], *cut['command'], *cut['battery_state'],
                    findings=findings)
    _check_robot(flight, robot, p)
    return flight


def _unusable(name, topic, cause, at_s=None):
    """An error with one damage, as the checks of :mod:`recording` report it."""
    damage = Damage(name, topic, cause, at_s)
    return UnusableFlight(damage.text, [damage])


def _in_order(name, topic, recording, findings):
    """Finite samples in ascending order, without repeated stamps."""
    t, values = recording.times[topic], recording.values[topic]
    fine = np.isfinite(t) & np.isfinite(values).all(axis=1)
    if not fine.all():
        findings.append(f'{name}: {topic}: {int((~fine).sum())} messages hold no numbers')
        t, values = t[fine], values[fine]
    if back := int((np.diff(t) < 0).sum()):
        findings.append(f'{name}: {topic}: {back} messages are out of order; sorted by stamp')
    t, first = np.unique(t, return_index=True)
    lost = len(values) - len(first)
    if lost > 2:
        findings.append(f'{name}: {topic}: {lost} stamps occur twice')
    return t, values[first]


def _with_charge(recording):
    """The charge drawn since the first message [A h] in place of the current of either sign."""
    t, (voltage, current) = recording.times['battery_state'], recording.values['battery_state'].T
    known = np.isfinite(t) & np.isfinite(current)
    at, rows = np.unique(t[known], return_index=True)
    drawn = np.zeros(len(t))
    if len(at) > 1:
        charge = cumulative_trapezoid(current[known][rows], at, initial=0) / 3600
        drawn = np.interp(t, at, np.abs(charge))
    return changed(recording, 'battery_state', values=np.column_stack([voltage, drawn]))


def _without_gaps(name, series, begin, end, p, findings, origin):
    """The longest piece without a long gap in any topic."""
    breaks, lost, longest = [], 0.0, (0.0, '', 0.0)
    for topic in NEEDED:
        t = series[topic][0]
        begin, end = max(begin, t[0]), min(end, t[-1])
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
        raise _unusable(name, topic, f'silent for {silence:.2f} s; {lost:.1f} s of '
                        f'{end - begin:.1f} s of flight are missing', at_s)
    edges = [begin, *(x for gap in sorted(breaks) for x in gap), end]
    pieces = [(edges[k], edges[k + 1]) for k in range(0, len(edges), 2)]
    return max(pieces, key=lambda piece: piece[1] - piece[0])


def _check_robot(flight, robot, p):
    """Refuse a flight of a completely different robot."""
    total = np.median(np.linalg.norm(flight.imu[:, :3], axis=1))
    if total < 0.3 * robot.gravity:
        raise _unusable(flight.name, 'imu/data_raw', f'specific force is {total:.2f} m/s^2, '
                        f'near {robot.gravity:.2f} m/s^2 expected')
    commanded = np.median(flight.command[:, 4:].sum(axis=1)) / robot.mass
    # Thrusts may partly cancel each other, so only too small a sum is impossible.
    if commanded < (1 - p.wrong_robot) * total or commanded > 3 * total:
        raise _unusable(flight.name, 'command', 'the robot file does not fit: commanded thrust '
                        f'over its mass is {commanded:.1f} m/s^2, the IMU measures '
                        f'{total:.1f} m/s^2')


def check_apart(runs: list[Path]) -> None:
    """
    Refuse a recording that is given twice, even under different names.

    A flight that is both fitted and held out would confirm any fit.

    Raises:
        BagError: no recording at a path.
        ParameterError: the same recording twice, with both paths.

    """
    known: dict[tuple, Path] = {}
    for run in runs:
        files = [run] if run.suffix.lower() in TABLES else bag_files(run)
        if not all(file.is_file() for file in files):
            continue        # reading it raises the error
        digest = tuple(hashlib.sha256(file.read_bytes()).hexdigest() for file in files)
        if digest in known:
            raise ParameterError(f'{known[digest]} and {run}: the same recording twice; '
                                 'expected different flights, each once')
        known[digest] = run


def check_flights(runs: list[Path], flights: list[Flight], same: float) -> None:
    """
    Refuse one flight in two different files: cut, converted or recorded twice.

    Two flights are the same from this share of equal IMU readings.

    Raises:
        ParameterError: with both paths.

    """
    readings = [{row.tobytes() for row in flight.imu} for flight in flights]
    for k, own in enumerate(readings):
        for j in range(k):
            if len(own & readings[j]) > same * min(len(own), len(readings[j])):
                raise ParameterError(f'{runs[j]} and {runs[k]}: the same flight in two '
                                     'recordings; expected different flights, each once')
