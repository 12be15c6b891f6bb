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
from beetle_omni_ros.identify.rotor.log import chosen, read_rotor_log
from beetle_omni_ros.identify.servo import page as of_joints
from beetle_omni_ros.identify.servo.joint import identify, joint_results
from beetle_omni_ros.identify.servo.log import read_joint_log
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.page import page, print_grids, Terminal


def run_identify_joint(paths: Sequence[Path], *, validate: Sequence[Path] = (),
                       robot: Path | None = None, json_path: Path | None = None,
                       report: Path | None = None, params: Path | None = None,
                       console: Console | None = None) -> dict:
    """
    Identify the tilt servos from response logs.

    Arguments are those of `beetle_omni identify joint`.

    Returns:
        ``joints`` and ``meta``.

    Raises:
        LogError, ParameterError: unusable input.

    """
    console = console or Terminal()
    check_differs(params, robot)
    robot_parameters = RobotParameters.load(robot)
    logs = [read_joint_log(path) for path in paths]
    validations = [read_joint_log(other) for other in validate]
    with console.status(f'identifying {len(logs[0].joints)} joints'):
        found = identify(logs, robot_parameters)
    results = joint_results(found, validations, robot_parameters)
    if robot:
        results['meta']['robot'] = str(robot)
    _print(console, of_joints.grids(results), results['text'])
    write_json(json_path, results)
    if report:
        write_text(report, of_joints.joint_page(found, validations, robot_parameters, results),
                   'report')
    if params:
        write_measured(params, robot_parameters, robot, _line('joint', paths, robot, params),
                       paths, servo_values(found, robot_parameters), None)
    return results


def run_identify_rotor(paths: Sequence[Path], *, columns: Sequence[str] = (),
                       rate: float | None = None, robot: Path | None = None,
                       json_path: Path | None = None, report: Path | None = None,
                       params: Path | None = None, console: Console | None = None) -> dict:
    """
    Identify a rotor's thrust, torque and lag from logs of a force-torque stand.

    Arguments are those of `beetle_omni identify rotor`.

    Returns:
        ``verdict``, ``surface``, ``plateaus``, ``torque``, ``torque_to_thrust_ratio``, ``lag``,
        ``temperature``, ``warnings`` and ``meta``.

    Raises:
        LogError, ParameterError: unusable input.

    """
    console = console or Terminal()
    check_differs(params, robot)
    robot_parameters = RobotParameters.load(robot)
    mapping = chosen(columns)
    model = of_rotor.identify_rotor([read_rotor_log(path, mapping, rate) for path in paths])
    results = of_rotor.rotor_results(model)
    if robot:
        results['meta']['robot'] = str(robot)
    _print(console, of_rotor.grids(results), [f'verdict: {results["verdict"]}', *(
        f'warning: {w}' for w in results['warnings'])])
    write_json(json_path, results)
    if report:
        write_text(report, of_rotor.rotor_page(model, robot_parameters, results), 'report')
    if params:
        write_measured(params, robot_parameters, robot,
                       _line('rotor', paths, robot, params, rate, columns), paths, None,
                       rotor_values(results))
    return results


def run_identify_robot(paths: Sequence[Path], params: Path, *, rate: float | None = None,
                       robot: Path | None = None, json_path: Path | None = None,
                       report: Path | None = None, console: Console | None = None) -> dict:
    """
    Write a robot file from logs of servos and rotors.

    Arguments are those of `beetle_omni identify robot`.

    Returns:
        ``robot``, the content of the file; ``servos`` and ``rotor``, the results of `identify
        joint` and `identify rotor`; ``warnings``.

    Raises:
        LogError, ParameterError: unusable input.

    """
    console = console or Terminal()
    check_differs(params, robot)
    robot_parameters = RobotParameters.load(robot)
    joints, rotors, notes = read_logs(paths, rate)
    results: dict = {'servos': None, 'rotor': None, 'warnings': notes}
    servo = rotor = None
    tables, sections = [], []
    if joints:
        with console.status('identifying the servos'):
            found = identify(joints, robot_parameters, as_file=True)
            servo = servo_values(found, robot_parameters)
        results['servos'] = joint_results(found, [], robot_parameters)
        tables += of_joints.grids(results['servos'])
        sections += of_joints.joint_sections(found, [], robot_parameters) if report else []
    if rotors:
        model = of_rotor.identify_rotor(rotors)
        results['rotor'] = of_rotor.rotor_results(model)
        rotor = rotor_values(results['rotor'])
        tables += of_rotor.grids(results['rotor'])
        sections += of_rotor.rotor_sections(model, robot_parameters) if report else []
    results['robot'] = write_measured(params, robot_parameters, robot, _line(
        'robot', paths, robot, params, rate), paths, servo, rotor)
    if joints:
        tables.append(of_joints.flown_errors(joints, {
            robot.stem if robot else 'published': robot_parameters,
            'measured': RobotParameters.load(params)}))
    _print(console, tables, [f'warning: {note}' for note in notes])
    write_json(json_path, results)
    if report:
        write_text(report, page('Robot', f'identified for {params.name}', tables, notes, sections),
                   'report')
    return results


def _line(what, paths, robot, params, rate=None, columns=()):
    """The command, for the written file."""
    options = (('--rate', f'{rate:g}' if rate else None), ('--robot', robot), ('--params', params))
    return shlex.join(map(str, (
        'beetle_omni', 'identify', what, *paths, *(x for c in columns for x in ('--column', c)),
        *(x for name, value in options if value for x in (name, value)))))


def _print(console, tables, notes):
    print_grids(tables, console)
    for note in notes:
        console.print(note, highlight=False, markup=False)
