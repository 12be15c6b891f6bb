"""`beetle_omni identify`: from measured logs to numbers, a page and a robot file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
import re

from beetle_omni_ros.identify.robot_file import check_differs, Measured, write_measured
from beetle_omni_ros.identify.rotor import results as of_rotor
from beetle_omni_ros.identify.rotor.log import (
    chosen,
    COLUMNS,
    EXPECTED,
    read_rotor_log,
    UntimedError,
)
from beetle_omni_ros.identify.servo import results as of_joints
from beetle_omni_ros.identify.servo.log import HEADER, is_bag, read_joint_log
from beetle_omni_ros.identify.servo.measured import measured
from beetle_omni_ros.model.files import LogError, write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.page import page, print_end, print_grids, Terminal

TITLES = {'joint': 'Tilt servos', 'rotor': 'Rotor', 'robot': 'Robot'}


def run_identify(what: str, paths: Sequence[Path], *, validate: Sequence[Path] = (),
                 columns: Sequence[str] = (), rate: float | None = None,
                 robot: Path | None = None, json_path: Path | None = None,
                 report: Path | None = None, params: Path | None = None) -> dict:
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
    console, whole = Terminal(), what == 'robot'
    check_differs(params, robot)
    parameters = RobotParameters.load(robot)
    joints, rotors, notes = read_logs(what, paths, chosen(columns), rate)
    others = [read_joint_log(path) for path in validate]
    results: dict = {'servos': None, 'rotor': None, 'warnings': notes}
    tables, sections, texts = [], [], [f'warning: {note}' for note in notes]
    found: list[Measured] = []
    if joints:
        with console.status('identifying the servos'):
            search = of_joints.identify(joints, parameters, as_file=whole)
            found += measured(search, parameters) if params else []
        results['servos'] = of_joints.joint_results(search, others, parameters)
        tables += of_joints.grids(results['servos'])
        sections += of_joints.sections(search, others, parameters) if report else []
        texts += [] if whole else results['servos']['text']
    if rotors:
        model = of_rotor.identify_rotor(rotors)
        results['rotor'] = of_rotor.rotor_results(model)
        found = [*of_rotor.measured(results['rotor']), *found]      # in the order of a file
        tables += of_rotor.grids(results['rotor'])
        sections += of_rotor.sections(model, parameters) if report else []
        texts += [] if whole else [f'verdict: {results["rotor"]["verdict"]}', *(
            f'warning: {warning}' for warning in results['rotor']['warnings'])]
    if params:
        results['robot'] = write_measured(params, parameters, robot, paths, found)
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
    Logs of joints, logs of rotors, and sentences about logs that were left out.

    If all kinds are expected (`robot`), the header decides, and time series without times are left
    out unless ``rate`` is given.
    """
    joints, rotors, notes = [], [], []
    for path in paths:
        if (_kind(path) if what == 'robot' else what) == 'joint':
            joints.append(read_joint_log(path))
            continue
        try:
            rotors.append(read_rotor_log(path, columns, rate))
        except UntimedError as error:
            if what == 'rotor':
                raise
            notes.append(f'not used: {error}')
    return joints, rotors, notes


def _kind(path):
    """`joint` for a bag, else by the first line without #; `rotor` if there is no file."""
    if is_bag(path):
        return 'joint'
    if not path.is_file():
        return 'rotor'      # its reader states the reason
    with open(path, encoding='utf-8', errors='replace') as file:
        header = next((line for line in file if not line.startswith('#')), '')
    thrust = '|'.join(COLUMNS['thrust'])
    for kind, column in (('joint', r'q\d_rad'), ('rotor', rf'(rotor\d+_)?({thrust})')):
        if any(re.fullmatch(column, cell.strip(' \ufeff\n')) for cell in header.split(',')):
            return kind
    raise LogError(f'{path}: expected the header of a log of joints ({HEADER}) or of a rotor '
                   f'({EXPECTED})')
