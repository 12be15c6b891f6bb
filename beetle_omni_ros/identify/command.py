"""`beetle_omni identify`: from measured logs to numbers, a page and a robot file."""

from collections.abc import Sequence
from pathlib import Path
import shlex

from rich.console import Console

from beetle_omni_ros.identify.measured import (
    read_logs,
    rotor_values,
    servo_values,
    write_measured,
)
from beetle_omni_ros.identify.robot_file import check_differs
from beetle_omni_ros.identify.rotor import results as of_rotor
from beetle_omni_ros.identify.rotor.log import chosen
from beetle_omni_ros.identify.servo import results as of_joints
from beetle_omni_ros.identify.servo.log import read_joint_log
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.page import page, print_end, print_grids, Terminal

TITLES = {'joint': 'Tilt servos', 'rotor': 'Rotor', 'robot': 'Robot'}


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
        results['robot'] = write_measured(params, parameters, robot, _line(
            what, paths, robot, params, rate, columns), paths, servo, rotor)
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
    print_end(console, [params, report, json_path], ('evaluate', '--plant', params)
              if params else 'the same with --params FILE writes a robot file')
    return results


def _line(what, paths, robot, params, rate, columns):
    """The command, for the written file."""
    options = (('--rate', f'{rate:g}' if rate else None), ('--robot', robot), ('--params', params))
    return shlex.join(map(str, (
        'beetle_omni', 'identify', what, *paths, *(x for c in columns for x in ('--column', c)),
        *(x for name, value in options if value for x in (name, value)))))
