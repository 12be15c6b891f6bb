"""
`beetle_omni identify`: from measured logs to numbers, a page and a robot file.

A value of the file is that of servos with the same gains in all logs. Its interval also covers
gains that differ between logs, because a log seldom separates bandwidth, damping and delay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import hashlib
from pathlib import Path
import re
import shlex
import sys

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.robot_file import check_differs, rounded, write_robot_file
from beetle_omni_ros.identify.rotor import results as of_rotor
from beetle_omni_ros.identify.rotor.log import (
    chosen,
    COLUMNS,
    EXPECTED,
    read_rotor_log,
    UntimedError,
)
from beetle_omni_ros.identify.servo import results as of_joints
from beetle_omni_ros.identify.servo.fit import decoded, HIGH, LOW, Search, ServoModel, STARTS
from beetle_omni_ros.identify.servo.log import HEADER, is_bag, read_joint_log
from beetle_omni_ros.identify.servo.model import catalogue_values, INDEX, JOINTS, own_delay
from beetle_omni_ros.model.effects import CATALOGUE, settings
from beetle_omni_ros.model.files import LogError, write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters, TILT_LAG
from beetle_omni_ros.show.page import page, print_end, print_grids, Terminal

TITLES = {'joint': 'Tilt servos', 'rotor': 'Rotor', 'robot': 'Robot'}
MILLI = 1e3
# Standard deviation of the gains between logs, for intervals. From 0.1 to 0.4 it moves the gains
# of the measured logs by less than 5 %, and doubles the width of the least informative one.
BETWEEN = 0.2
DRAWS = 4000            # of the parameters, whose quantiles are the intervals
TAILS = 2.5, 97.5       # [%] outside a 95 % interval
GAINS = 'natural_frequency', 'damping_ratio'
HEAD = """\
# The robot as its logs show it; `provenance` has command, logs and the origin of each value, and
# `intervals` the 95 % intervals [lowest, highest]. Lists are of gimbal1 to gimbal4. Units: kp
# [N m/rad], kd [N m s/rad], coulomb and stiction [N m], gap, sine and cosine [rad], delay,
# tilt_lag and time_constant [s], torque_to_thrust_ratio [m]. A row of the map is as in robot.yaml.
"""


def run_identify(what: str, paths: Sequence[Path], *, validate: Sequence[Path] = (),
                 columns: Sequence[str] = (), rate: float | None = None,
                 robot: Path | None = None, json_path: Path | None = None,
                 report: Path | None = None, params: Path | None = None,
                 console: Console | None = None) -> dict:
    """
    Identify tilt servos or a rotor from their logs, or write a robot file from both.

    ``what`` is `joint`, `rotor` or `robot`; the other arguments are those of this subcommand of
    `beetle_omni identify`.

    Returns:
        Results of the servos (``meta``, ``joints``, ``text``), those of the rotor (``verdict``,
        ``surface``, ``plateaus``, ``lag``, ...), or both as ``servos`` and ``rotor`` with
        ``robot``, the content of the file, and ``warnings``.

    Raises:
        LogError, ParameterError: unusable input.

    """
    console, whole = console or Terminal(), what == 'robot'
    check_differs(params, robot)
    parameters = RobotParameters.load(robot)
    joints, rotors, notes = read_logs(what, paths, chosen(columns), rate)
    others = [read_joint_log(path) for path in validate]
    results: dict = {'servos': None, 'rotor': None, 'warnings': notes}
    tables, sections, texts = [], [], [f'warning: {note}' for note in notes]
    servo = rotor = None
    if joints:
        with console.status('identifying the servos'):
            search = of_joints.identify(joints, parameters, as_file=whole)
            servo = servo_values(search, parameters) if params else None
        results['servos'] = of_joints.joint_results(search, others, parameters)
        tables += of_joints.grids(results['servos'])
        sections += of_joints.sections(search, others, parameters) if report else []
        texts += [] if whole else results['servos']['text']
    if rotors:
        model = of_rotor.identify_rotor(rotors)
        results['rotor'] = of_rotor.rotor_results(model)
        rotor = rotor_values(results['rotor'])
        tables += of_rotor.grids(results['rotor'])
        sections += of_rotor.sections(model, parameters) if report else []
        texts += [] if whole else [f'verdict: {results["rotor"]["verdict"]}', *(
            f'warning: {warning}' for warning in results['rotor']['warnings'])]
    if params:
        results['robot'] = write_measured(params, parameters, robot, paths, servo, rotor)
    if whole and joints:
        tables.append(of_joints.flown_errors(joints, {
            robot.stem if robot else 'published': parameters,
            'measured': RobotParameters.load(params)}))
    for part in (results['servos'], results['rotor']):
        if part and robot:
            part['meta']['robot'] = str(robot)
    print_grids(tables, console)
    for text in texts:
        console.print(text, highlight=False, markup=False)
    results = results if whole else results['servos' if joints else 'rotor']
    write_json(json_path, results)
    if report:
        about = f'identified for {params.name}' if params and whole else \
            f'identified from {", ".join(log.name for log in [*joints, *rotors])}'
        write_text(report, page(TITLES[what], about, tables, texts, sections), 'report')
    print_end(console, [params, report, json_path],
              *([f'open {report} in a browser'] if report else []), ('evaluate', '--plant', params)
              if params else 'the same with --params FILE writes a robot file')
    return results


def read_logs(what: str, paths: Sequence[Path], columns: Mapping[str, tuple[str, float]],
              rate: float | None) -> tuple[list, list, list[str]]:
    """
    Read logs of joints and of rotors.

    Args:
        what: `joint` or `rotor`, the kind of all logs, or `robot`: the header decides.
        paths: CSV files, or bags with responses of the joints.
        columns: of rotors, see :func:`chosen`.
        rate: rows a second of time series without times [Hz]; None: `robot` leaves them out.

    Returns:
        logs of joints, logs of rotors, and sentences about logs that were left out.

    Raises:
        LogError: an unusable log, or one of neither kind.

    """
    joints, rotors, notes = [], [], []
    for path in paths:
        if what == 'joint' or what == 'robot' and (is_bag(path) or _names(path, r'q\d_rad')):
            joints.append(read_joint_log(path))
            continue
        thrust = r'(rotor\d+_)?({})'.format('|'.join(COLUMNS['thrust']))
        if what == 'robot' and path.is_file() and not _names(path, thrust):
            raise LogError(f'{path}: expected the header of a log of joints ({HEADER}) or of a '
                           f'rotor ({EXPECTED})')
        try:
            rotors.append(read_rotor_log(path, columns, rate))
        except UntimedError as error:
            if what == 'rotor':
                raise
            notes.append(f'not used: {error}')
    return joints, rotors, notes


def _names(path, pattern):
    """Whether the first line without # of a file has a cell that matches."""
    try:
        with open(path, encoding='utf-8', errors='replace') as file:
            line = next((line for line in file if not line.startswith('#')), '')
    except OSError:
        return False        # its reader states the reason
    return any(re.fullmatch(pattern, cell.strip(' \ufeff\n')) for cell in line.split(','))


def servo_values(search: Search, robot: RobotParameters) -> tuple[dict, dict, dict]:
    """
    Effects of the selected servo model.

    A zero is not written: it is set anew by each homing, and differs between logs. A weight on the
    joints has no key in a robot file.

    Returns:
        ``effects``, ``intervals`` and the origin of each, by dotted key.

    """
    servos = search.servos
    spreads = list(servos.spreads)
    for p in (INDEX[name] for name in GAINS):
        spreads[p] = replace(spreads[p], groups=spreads[p].groups | {'log': BETWEEN})
    servos.spreads, kept = spreads, servos.spreads
    apart = servos.fit(search.chosen.entries, starts=(search.chosen, *STARTS))
    servos.spreads = kept
    # each: {entry: {parameter: (JOINTS or 1, draws)}}
    best = _entries(search, search.chosen, None, robot, 1)
    others = [_entries(search, trial, k, robot, DRAWS) for trial in (search.chosen, apart)
              for k in (None, *range(len(servos.logs)))]
    effects: dict = {}
    intervals, origin = {}, {}
    how = {'logs': [log.name for log in servos.logs], 'how': 'mean of the logs, '
           'with the same gains; interval: also of each log, with gains that differ between logs'}
    for entry, parameters in best.items():
        effects[entry] = {}
        for name, drawn in parameters.items():
            if CATALOGUE[entry].parameters[name].form:
                effects[entry][name] = float(drawn[0, 0])
                continue
            value = drawn[:, 0]
            ends = [np.percentile(other[entry][name], TAILS, axis=1) for other in others]
            low = np.minimum(np.min(ends, axis=0)[0], value)
            high = np.maximum(np.max(ends, axis=0)[1], value)
            key = f'effects.{entry}.{name}'
            effects[entry][name] = rounded(value, 4)
            intervals[key] = rounded([low, high], 4)
            origin[key] = how
    if effects.keys() >= {'joint_bandwidth', 'joint_command_latency'}:
        lags = [other['joint_bandwidth']['kd'] / other['joint_bandwidth']['kp']
                + other['joint_command_latency']['delay'] for other in (best, *others)]
        low, *_, high = np.percentile(np.concatenate(lags[1:], axis=1), TAILS, axis=1)
        low, high = np.minimum(low, lags[0][:, 0]), np.maximum(high, lags[0][:, 0])
        intervals[TILT_LAG] = rounded([low, high], 4)
        origin[TILT_LAG] = how | {'how': 'Kd / Kp plus delay [s]; the logs determine the sum '
                                         'better than its parts'}
    if 'joint_offset' in search.chosen.entries:
        zeros = MILLI * search.values()[:, INDEX['offset']]
        origin['not written: joint_offset'] = how | {
            'how': f'zeros of {zeros.min():.1f} to {zeros.max():.1f} mrad; each homing sets them'}
    delay = search.values()[:, INDEX['delay']].mean()
    origin['effects.joint_command_latency.delay'] = how | {
        'how': f'{delay:.4f} s in the mean of the logs, minus {own_delay():.3f} s that the '
               'simulator has; at least 0'}
    return effects, intervals, origin


def _entries(search: Search, trial: ServoModel, log: int | None, robot: RobotParameters, draws: int
             ) -> dict[str, dict[str, np.ndarray]]:
    """
    Entries of a log, or of the mean of all logs (None): (joints, draws) values of each parameter.

    One draw is the estimate. A joint without a log is the median of the others.
    """
    fit, units = trial.fit, search.servos.units
    x = fit.x[:, None]
    if draws > 1:
        factor = np.linalg.cholesky(fit.covariance() + 1e-12 * np.eye(len(fit.x)))
        x = x + factor @ np.random.default_rng(0).normal(size=(len(fit.x), draws))
    sets = []
    for number in range(1, JOINTS + 1):
        mine = [u for u, (k, _, n) in enumerate(units) if n == number and log in (None, k)]
        if mine:
            sets.append(search.servos.base[mine[0]][:, None] + fit.s[mine].mean(axis=0) @ x)
    logs = decoded(np.clip(np.array(sets), LOW[:, None], HIGH[:, None]).transpose(0, 2, 1))
    values = catalogue_values(logs.transpose(2, 0, 1), robot)
    result: dict[str, dict[str, np.ndarray]] = {}
    present = sorted({number for *_, number in units})
    for entry in trial.entries:
        for name, given in values.get(entry, {}).items() if entry != 'joint_offset' else ():
            parameter = CATALOGUE[entry].parameters[name]
            value = np.broadcast_to(given, logs.shape[:2])
            if entry == 'joint_command_latency':
                value = np.maximum(value.mean(axis=0, keepdims=True), 0)
            elif not (parameter.of_each or isinstance(parameter.neutral, tuple)):
                value = value.mean(axis=0, keepdims=True)
            elif len(value) < JOINTS:
                value = np.array([value[present.index(n)] if n in present else
                                  np.median(value, axis=0) for n in range(1, JOINTS + 1)])
            result.setdefault(entry, {})[name] = value
    return result


def rotor_values(results: dict) -> tuple[dict, dict, dict]:
    """
    Keys of ``rotors`` from the results of a rotor identification.

    Returns:
        ``rotors``, ``intervals`` and the origin of each, by dotted key.

    """
    rotors: dict = {}
    intervals, origin = {}, {}
    lag, ratio = results['lag'], results['torque_to_thrust_ratio']
    logs = results['meta']['log'].split(', ')
    if ratio:
        rows = results['plateaus']
        rotors = {'torque_to_thrust_ratio': rounded(ratio['value']), 'map': [
            {'voltage': round(p['voltage_V'], 3), 'thrust_max': round(p['thrust_max_N'], 4),
             'coefficients': [round(p['coefficients'][f'c{k}']['value'], 8) for k in range(4)]}
            for p in rows]}
        intervals['rotors.torque_to_thrust_ratio'] = rounded(ratio['interval'], 4)
        band = max(p['thrust_half_width_N'] for p in rows)
        origin['rotors.torque_to_thrust_ratio'] = {
            'logs': logs, 'how': 'slope of torque over thrust of settled steps'}
        origin['rotors.map'] = {'logs': logs, 'how': (
            'cubics of the surface of settled steps, to the largest of their thrusts; 95 % band '
            f'{band:.2f} N, at a voltage left out {results["surface"]["left_out_rms_N"]:.2f} N '
            'RMS')}
    if lag and 'value' in lag and results['verdict'] != 'bad_data':
        shown = [one for one in lag['logs'] if 'value' in one]
        low, high = zip(*(one['interval'] for one in shown), strict=True)
        rotors['time_constant'] = rounded(lag['value'], 4)
        intervals['rotors.time_constant'] = rounded([min(low), max(high)], 4)
        origin['rotors.time_constant'] = {'logs': [one['log'] for one in shown], 'how': (
            f'both directions of {lag["log"]}'
            + ' with a gain for each window, as thrust and command do not belong together' * bool(
                lag['reason']) + '; interval: of all these logs')}
    return rotors, intervals, origin


def write_measured(path: Path, robot: RobotParameters, base: Path | None,
                   logs: Sequence[Path], servo: tuple | None, rotor: tuple | None) -> dict:
    """
    Write a robot file that extends ``base`` by measured values.

    Args:
        path: output file.
        robot: robot of ``base``.
        base: extended file; None: the shipped one.
        logs: files of the logs.
        servo: of :func:`servo_values`.
        rotor: of :func:`rotor_values`.

    Returns:
        Content of the file.

    Raises:
        LogError: the logs show nothing for it.
        ParameterError: the file cannot be written.

    """
    (effects, *of_servo), (rotors, *of_rotor) = servo or ({},) * 3, rotor or ({},) * 3
    if not effects and not rotors:
        raise LogError(f'{path}: no robot file written, because the logs show no value of it '
                       '(verdict bad_data of a rotor log?)')
    intervals, origin = ({**a, **b} for a, b in zip(of_rotor, of_servo, strict=True))
    merged = robot.effects | effects
    stated = {*intervals, *(f'rotors.{name}' for name in rotors), *settings(effects)}
    content = {
        **({'rotors': rotors} if rotors else {}), **({'effects': merged} if effects else {}),
        'intervals': intervals,
        'provenance': {
            'command': shlex.join(['beetle_omni', *sys.argv[1:]]), 'version': __version__,
            'logs': {log.name: {'sha256': hashlib.sha256(log.read_bytes()).hexdigest()}
                     for log in logs if log.is_file()},
            'origin': origin,
            'of_the_extended_file': [key for key in _keys(robot) if key not in stated]}}
    write_robot_file(path, HEAD, content, base)
    return content


def _keys(robot):
    """Dotted keys of a robot file, of sections with their own keys."""
    for name, value in robot.as_dict().items():
        if name in ('rotors', 'joints'):
            yield from (f'{name}.{key}' for key in value)
        elif name == 'effects':
            yield from (f'{name}.{effect}' for effect in value)
        else:
            yield name
