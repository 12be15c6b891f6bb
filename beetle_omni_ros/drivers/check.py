"""`beetle_omni check`: checks ports, servos, motor board and topics, and prints remedies."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from beetle_omni_ros import __version__
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.findings import check_topics, FAIL, Findings, ObservedGraph, OK, WARN
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

PARTS = ('servos', 'board', 'ros')
STYLES = {OK: 'green', WARN: 'yellow', FAIL: 'bold red'}


def run_check(*, listen: Callable[[float], ObservedGraph], servo_port: str | None = None,
              board_port: str | None = None, servo_bus: Path | None = None,
              motor_board: Path | None = None, robot: Path | None = None, seconds: float = 3.0,
              skip: tuple[str, ...] = (), json_path: Path | None = None,
              measure: Callable[[RobotParameters], Findings] | None = None) -> int:
    """
    Check everything and print a table.

    The arguments are the options of `beetle_omni check`. ``listen`` observes the ROS graph for a
    number of seconds, without ROS it raises ModuleNotFoundError. ``measure`` replaces all parts.

    Returns:
        exit status: 0 if nothing failed, else 1.

    Raises:
        ParameterError: unusable input, in one line.
        ModuleNotFoundError: a library of the drivers of an unskipped device.

    """
    for part in skip:
        if part not in PARTS:
            raise ParameterError(f"--skip '{part}': expected {', '.join(PARTS)}")
    console = Console()
    bus, link = ServoBusParameters.load(servo_bus), MotorBoardParameters.load(motor_board)
    robot_parameters = RobotParameters.load(robot)
    bus = replace(bus, port=servo_port or bus.port)
    link = replace(link, port=board_port or link.port)
    graph, found, ros = None, {}, Findings()
    if measure:
        skip = PARTS
        with console.status('replaying a flight in real time'):
            found['timing'] = measure(robot_parameters)
    if 'ros' not in skip:
        with console.status(f'listening to ROS for {seconds:g} s'):
            graph = _observed(listen, seconds, ros)
    if 'servos' not in skip:
        from beetle_omni_ros.drivers.device_checks import check_servos  # has driver libraries
        with console.status(f'checking the servos on {bus.port}'):
            found['servos'] = check_servos(bus, robot_parameters.joints, graph)
    if 'board' not in skip:
        from beetle_omni_ros.drivers.device_checks import check_board
        with console.status(f'listening to the motor board on {link.port}'):
            found['board'] = check_board(link, robot_parameters, seconds, graph)
    if 'ros' not in skip:
        found['ros'] = check_topics(graph, robot_parameters.gravity) if graph else ros
    _print(console, found, skip)
    is_ok = all(finding.level != FAIL for rows in found.values() for finding in rows)
    write_json(json_path, {
        'ok': is_ok,
        'findings': [{'part': part, **asdict(finding)} for part, rows in found.items()
                     for finding in rows],
        'meta': {'version': __version__, 'servo_port': bus.port, 'board_port': link.port,
                 'seconds': seconds, 'skipped': list(skip)}})
    return 0 if is_ok else 1


def _observed(listen, seconds, findings):
    """Observe the graph; None, with a finding added, if ROS is missing or does not start."""
    try:
        return listen(seconds)
    except ModuleNotFoundError as error:
        module = (error.name or '').partition('.')[0]
        findings.add('ROS', f"the module '{module}' is not installed",
                     fail='source /opt/ros/jazzy/setup.bash, or --skip ros, or pip install '
                     "'beetle_omni_ros[ros]'")
    except (OSError, RuntimeError) as error:
        findings.add('ROS', f"does not start: {' '.join(str(error).split())}",
                     fail='check RMW_IMPLEMENTATION and network; or --skip ros')
    return None


def _print(console, found, skip):
    table = Table(*(Column(name, overflow='fold') for name in ('item', 'finding', '',
                                                               'what to do')),
                  title='Bring-up', title_justify='left')
    for rows in found.values():
        for finding in rows:
            table.add_row(Text(finding.item), Text(finding.found),
                          Text(finding.level, STYLES[finding.level]), Text(finding.remedy))
        table.add_section()
    console.print(table)
    levels = [finding.level for rows in found.values() for finding in rows]
    failed, warned = levels.count(FAIL), levels.count(WARN)
    skipped = f"; not checked: {', '.join(skip)}" if skip else ''
    console.print(f'{failed} failed, {warned} warnings, {levels.count(OK)} ok{skipped}',
                  highlight=False, style=STYLES[FAIL if failed else WARN if warned else OK])
