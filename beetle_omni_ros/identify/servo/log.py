"""Response logs of the tilt servos: commands and encoder readings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import BagError, read_bag, read_messages
from beetle_omni_ros.identify.recording.series import held_at, integral, runs
from beetle_omni_ros.model.files import LogError, missing, read_table

HEADER = 't_s,q1_rad,q2_rad,q3_rad,q4_rad,command_rad (or command1_rad to command4_rad)'
JOINTS: tuple[int, ...] = (1, 2, 3, 4)
NEIGHBOURS = 5      # readings on each side that determine the time of one
FITTED = 0.6        # share of a log; the rest is for validation
PERIODS = 2e-4, 0.1     # [s] between samples; slower sampling cannot resolve a servo
LONGEST_GAP = 0.25      # [s]
LEAST_DURATION = 2.0    # [s]
LEAST_SAMPLES = 100
LEAST_TRAVEL = 0.02     # [rad] of the command and of each joint
LARGEST_ANGLE = 13.0    # [rad] two turns; a larger value is not in radians
HISTORY = 0.3           # [s] before the log, in which the command is extrapolated
LONGEST_BAG = 30.0      # [s] used of a bag; more takes minutes and adds little information
LAST_COMMAND = 0.1      # [s] for which the actuators execute the last command


@dataclass(frozen=True)
class JointLog:
    """
    Commands and positions of several joints over time.

    Attributes:
        name: name of the file.
        t: (N,) increasing times [s].
        joints: (n,) numbers of the joints, 1 to 4.
        measured: (n, N) encoder positions [rad].
        command: (n, N) commanded positions [rad].

    """

    name: str
    t: np.ndarray
    joints: tuple[int, ...]
    measured: np.ndarray
    command: np.ndarray

    @cached_property
    def period(self) -> float:
        """Time between rows [s]."""
        return float(np.median(np.diff(self.t)))

    @cached_property
    def fresh(self) -> np.ndarray:
        """(N,) rows with a new reading; the others repeat the last one."""
        return fresh_rows(self.measured)

    @cached_property
    def read_t(self) -> np.ndarray:
        """
        (N,) times of the readings of fresh rows [s]; the others are nan.

        A reading can appear one row late or early. Its time is the median of the times of its
        neighbours, moved by whole periods. Readings in every row keep their times.
        """
        t, times = self.t[self.fresh], np.full(len(self.t), np.nan)
        period = float(np.median(np.diff(t)))
        if period >= 1.5 * self.period:
            number = np.r_[0, np.cumsum(np.maximum(np.rint(np.diff(t) / period), 1))]
            period = float(np.polyfit(number, t, 1)[0])
            about = np.pad(t - number * period, NEIGHBOURS, mode='reflect')
            windows = np.lib.stride_tricks.sliding_window_view(about, 2 * NEIGHBOURS + 1)
            t = np.median(windows, axis=1) + number * period
        times[self.fresh] = t
        return times

    @cached_property
    def start(self) -> np.ndarray:
        """(2, n) first positions [rad] and velocities [rad/s]."""
        used = np.flatnonzero(self.fresh)[:max(4, int(self.fresh[:self._first].sum()))]
        return np.polyfit(self.read_t[used] - self.t[0], self.measured[:, used].T, 2)[:0:-1]

    @property
    def _first(self) -> int:
        """Number of rows of the first 40 ms."""
        return max(4, int(round(0.04 / self.period)) + 1)

    @cached_property
    def _commands(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (M,), commands (M, n) with a straight line before the log, their integrals."""
        slope = np.polyfit(self.t[:self._first] - self.t[0], self.command[:, :self._first].T, 1)[0]
        back = -self.period * np.arange(int(HISTORY / self.period) + 1, 0, -1)
        t = np.concatenate([self.t[0] + back, self.t])
        command = np.concatenate([self.command[:, :1] + slope[:, None] * back, self.command], 1)
        return t, *integral(t, command.T)

    def command_at(self, joint: int, times: np.ndarray) -> np.ndarray:
        """Command of a joint (index) by linear interpolation [rad]; linear before the log."""
        t, command, _ = self._commands
        return np.interp(times, t, command[:, joint])

    def held_command(self, joint: int, edges: np.ndarray) -> np.ndarray:
        """Means (K,) over the steps between ``edges`` (K + 1,) of the command held until a row."""
        t, *commands = self._commands
        sums = held_at(edges, t, *(part[:, joint, None] for part in commands))[:, 0]
        return np.diff(sums) / np.diff(edges)

    @property
    def end(self) -> int:
        """Number of samples of the fitted part; the others are held out."""
        return int(round(FITTED * len(self.t)))

    def first(self) -> JointLog:
        """The fitted part of the log."""
        return JointLog(self.name, self.t[:self.end], self.joints, self.measured[:, :self.end],
                        self.command[:, :self.end])

    @property
    def quantum(self) -> float:
        """Step of the encoder [rad]: the smallest change of a reading."""
        return quantum(self.measured)

    def motion(self, joint: int) -> dict[str, list[float]]:
        """Ranges of a joint's angle [rad], and of rate and acceleration over 50 ms."""
        span = max(1, int(round(0.05 / self.period)))
        ranges = {}
        values = self.measured[joint, ::span]
        for name in ('angle_rad', 'rate_rad_s', 'acceleration_rad_s2'):
            ranges[name] = [float(values.min()), float(values.max())]
            values = np.diff(values) / (span * self.period)
        return ranges

    def command_speed(self) -> np.ndarray:
        """(n,) speed of each command that 1 % of the samples exceed [rad/s]."""
        return np.quantile(np.abs(np.gradient(self.command, self.t, axis=1)), 0.99, axis=1)

    def speed(self) -> np.ndarray:
        """(n,) largest mean speed of each joint over 50 ms [rad/s]."""
        span = max(1, int(round(0.05 / self.period)))
        travel = np.abs(self.measured[:, span:] - self.measured[:, :-span])
        return (travel / (self.t[span:] - self.t[:-span])).max(axis=1)

    def reached(self) -> dict[str, float]:
        """Largest speed [rad/s] and position error [rad]: a limit is not below them."""
        return {'velocity_limit': float(self.speed().max()),
                'torque_limit': float(np.abs(self.command - self.measured).max())}


def quantum(measured: np.ndarray) -> float:
    """Smallest change of the readings (n, N) of encoders [rad]; 0 if they never change."""
    steps = np.abs(np.diff(measured, axis=1))
    steps = steps[steps > 1e-5]
    return float(np.quantile(steps, 0.01)) if steps.size else 0.0


def fresh_rows(measured: np.ndarray) -> np.ndarray:
    """
    (N,) rows with a new reading.

    A logger may write rows faster than the bus delivers readings, and then repeats the last one.
    The most frequent number of rows between two changes is the period of the readings. Before a
    longer interval, or over it, joints that rest move by at most two encoder steps (a command may
    start them quickly), so each of its periods has a reading. If they move by more, the readings
    were held, so it has none.

    Args:
        measured: (n, N) readings of all joints [rad], delivered together.

    """
    changed = np.flatnonzero(np.r_[True, (np.diff(measured, axis=1) != 0).any(axis=0)])
    if len(changed) < 3:
        return np.ones(measured.shape[1], dtype=bool)
    gaps = np.diff(changed)
    period = int(np.bincount(gaps).argmax())
    jumps = np.abs(np.diff(measured[:, changed], axis=1)).max(axis=0)
    rested = (gaps > 1.5 * period) & (np.minimum(jumps, np.r_[0.0, jumps[:-1]])
                                      <= 2.01 * quantum(measured))
    fresh = np.zeros(measured.shape[1], dtype=bool)
    fresh[changed] = True
    for row, gap in zip(changed[:-1][rested], gaps[rested], strict=True):
        fresh[row:row + gap:period] = True
    fresh[changed[-1]::period] |= measured.shape[1] - changed[-1] <= 1.5 * period or \
        bool((measured[:, changed[-1]:] == measured[:, -1:]).all())
    return fresh


def read_joint_log(path: str | Path) -> JointLog:
    """
    Read a response log from CSV or a bag, and check it.

    Raises:
        LogError: with file, row or column, and expectation.

    """
    if is_bag(Path(path)):
        joints = JOINTS
        t, measured, command = read_bag_response(Path(path))
        rows = np.arange(1, len(t) + 1)
    else:
        columns, rows = read_table(path, _wanted, HEADER)
        t = columns['t_s']
        joints = tuple(k for k in JOINTS if f'q{k}_rad' in columns)
        measured = np.stack([columns[f'q{k}_rad'] for k in joints])
        command = np.stack([columns[own if (own := f'command{k}_rad') in columns
                                    else 'command_rad'] for k in joints])
    _check_times(path, t, rows)
    for k, position, wanted in zip(joints, measured, command, strict=True):
        _check_angles(path, k, position, wanted)
    return JointLog(Path(path).name, t, joints, measured, command)


def _wanted(header):
    joints = [k for k in JOINTS if f'q{k}_rad' in header] or JOINTS[:1]
    own = any(f'command{k}_rad' in header for k in joints) and 'command_rad' not in header
    names = ['t_s', *(f'q{k}_rad' for k in joints),
             *([f'command{k}_rad' for k in joints] if own else ['command_rad'])]
    for name in names:
        if name not in header:
            raise missing(name, header)
    return names


def _check_times(path, t, rows):
    if len(t) < LEAST_SAMPLES:
        raise LogError(f'{path}: {len(t)} rows are too few; expected at least '
                       f'{LEAST_SAMPLES}')
    steps = np.diff(t)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0)) + 1
        raise LogError(f'{path}: row {rows[k]}, column t_s: {t[k]:g} s does not come after '
                       f'{t[k - 1]:g} s; expected increasing times')
    period = float(np.median(steps))
    if not PERIODS[0] <= period <= PERIODS[1]:
        raise LogError(f'{path}: column t_s: samples are {period:g} s apart; expected '
                       f'{PERIODS[0]:g} to {PERIODS[1]:g} s (is the time in '
                       'seconds?)')
    if t[-1] - t[0] < LEAST_DURATION:
        raise LogError(f'{path}: {t[-1] - t[0]:.2f} s are too short; expected at least '
                       f'{LEAST_DURATION:g} s')
    if steps.max() > LONGEST_GAP:
        k = int(np.argmax(steps)) + 1
        raise LogError(f'{path}: row {rows[k]}: {steps.max():.2f} s without a sample; '
                       f'expected gaps below {LONGEST_GAP:g} s (split the log there)')


def _check_angles(path, joint, position, command):
    for name, values in (('the command', command), (f'q{joint}_rad', position)):
        if np.abs(values).max() > LARGEST_ANGLE:
            raise LogError(f'{path}: {name} reaches {np.abs(values).max():g}; expected radians '
                           f'within +-{LARGEST_ANGLE:g} (degrees or encoder counts?)')
        if np.ptp(values) < LEAST_TRAVEL:
            raise LogError(f'{path}: {name} moves by {np.ptp(values):.4f} rad only; expected at '
                           f'least {LEAST_TRAVEL:g} rad (a constant does not identify a '
                           'servo)')
    ratio = np.ptp(position) / np.ptp(command)
    if not 0.1 < ratio < 10:
        raise LogError(f'{path}: q{joint}_rad travels {ratio:.3g} times as far as its command; '
                       'expected the same unit, radians, in both')
    if np.corrcoef(position, command)[0, 1] < 0:
        raise LogError(f'{path}: q{joint}_rad moves against its command; expected both with the '
                       'same sign')


def is_bag(path: Path) -> bool:
    """Whether ``path`` is a rosbag2 folder or one of its files."""
    return path.is_dir() or path.suffix == '.mcap' or path.name == 'metadata.yaml'


def read_bag_response(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Read joint positions with the last command before each.

    Returns:
        (N,) times from the first [s], (4, N) positions [rad], (4, N) commands [rad], of the
        longest interval with commands; of a long one, the part of ``LONGEST_BAG`` with most
        motion.

    Raises:
        LogError: no bag, or one without joint_states or command.

    """
    try:
        log = read_bag(path)
    except (BagError, OSError) as error:
        raise LogError(str(error)) from None
    for name, count in (('joint_states', len(log.joint.t)), ('command', len(log.command.t))):
        if not count:
            raise LogError(f'{path}: no {name} in this bag')
    order = np.argsort(log.command.received, kind='stable')
    received, tilt = log.command.received[order], log.command.tilt[order]
    fresh = np.r_[True, np.diff(log.joint.t) > 0]
    t, position = log.joint.t[fresh], log.joint.position[fresh]
    last = np.searchsorted(received, t, side='right') - 1
    driven = (last >= 0) & (t - received[np.maximum(last, 0)] <= LAST_COMMAND)
    stretches = runs(driven)
    if not stretches:
        raise LogError(f'{path}: no joint_states during the commands; expected stamps of both by '
                       'one clock')
    first, length = max(stretches, key=lambda stretch: stretch[1])
    first, end = _most_motion(t, tilt[last], first, first + length)
    chosen = slice(first, end)
    return t[chosen] - t[first], position[chosen].T, tilt[last[chosen]].T


def _most_motion(t, command, first, end):
    """The part of an interval, at most ``LONGEST_BAG`` long, in which the commands travel most."""
    ends = np.minimum(np.searchsorted(t, t[first:end] + LONGEST_BAG, side='right'), end)
    travel = np.cumsum(np.r_[0.0, np.abs(np.diff(command[:end], axis=0)).sum(axis=1)])
    gain = travel[ends - 1] - travel[first:end]
    begin = first + int(np.argmax(gain))
    return begin, ends[begin - first]


def is_joint_log(path: Path) -> bool:
    """Whether a run is a table, or a bag in which joints and commands were recorded alone."""
    if path.suffix.lower() == '.csv':
        return True
    recorded: set[str] = set()
    try:
        for raw in read_messages(path):
            recorded.add(Path(raw.topic).name)
            if recorded & {'pose', 'data_raw', 'odom'}:     # the rest of a flight is not read
                return False
    except (BagError, OSError):
        return False
    return recorded >= {'joint_states', 'command'}
