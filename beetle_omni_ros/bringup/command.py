"""`beetle_omni check`: checks ports, servos, motor board and topics, and prints remedies."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from beetle_omni_ros import __version__
from beetle_omni_ros.bringup.board import check_board
from beetle_omni_ros.bringup.finding import FAIL, Finding, missing_library, OK, WARN
from beetle_omni_ros.bringup.graph import BRIDGES, ObservedGraph
from beetle_omni_ros.bringup.limits import CheckLimits
from beetle_omni_ros.bringup.servos import check_servos
from beetle_omni_ros.bringup.topics import check_topics
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.json_file import check_writable, write_json

SERVOS, BOARD, ROS = PARTS = ('servos', 'board', 'ros')
STYLES = {OK: 'green', WARN: 'yellow', FAIL: 'bold red'}


def run_check(*, listen: Callable[[float], ObservedGraph], servo_port: str | None = None,
              board_port: str | None = None, servo_bus: Path | None = None,
              motor_board: Path | None = None, robot: Path | None = None, seconds: float = 3.0,
              skip: tuple[str, ...] = (), json_path: Path | None = None,
              console: Console | None = None) -> int:
    """
    Check everything and print a table.

    The arguments are the options of `beetle_omni check`. ``listen`` observes the ROS graph for a
    number of seconds; it raises ModuleNotFoundError without ROS.

    Returns:
        exit status: 0 if nothing failed, else 1.

    Raises:
        ParameterError: unusable input, in one line.

    """
    for part in skip:
        if part not in PARTS:
            raise ParameterError(f"--skip '{part}': expected {', '.join(PARTS)}")
    check_writable(json_path)
    console, limits = console or Console(), CheckLimits.load()
    bus, link = ServoBusParameters.load(servo_bus), MotorBoardParameters.load(motor_board)
    robot_parameters = RobotParameters.load(robot)
    bus = replace(bus, port=servo_port or bus.port)
    link = replace(link, port=board_port or link.port)
    found: dict[str, list[Finding]] = {part: [] for part in PARTS if part not in skip}
    graph = None
    if ROS in found:
        with console.status(f'listening to ROS for {seconds:g} s'):
            graph = _observed(listen, seconds, found[ROS])
    if SERVOS in found:
        with console.status(f'checking the servos on {bus.port}'):
            found[SERVOS] = check_servos(bus, robot_parameters.joints, limits, graph)
    if BOARD in found:
        with console.status(f'listening to the motor board on {link.port}'):
            found[BOARD] = check_board(link, robot_parameters, limits, seconds, graph)
    if graph:
        items = [finding.item for rows in found.values() for finding in rows]
        reported = frozenset(bridge for bridge in BRIDGES if f'{bridge} state' in items)
        found[ROS] = check_topics(graph, limits, robot_parameters.gravity, reported)
    _print(console, found, skip)
    write_json(json_path, results(found, servo_port=bus.port, board_port=link.port,
                                  seconds=seconds, skipped=list(skip)))
    return 1 if any(f.level == FAIL for rows in found.values() for f in rows) else 0


def results(found: dict[str, list[Finding]], **meta) -> dict:
    """Content of the JSON file: ``ok``, ``findings`` in order, ``meta``."""
    rows = [finding.as_dict(part) for part, findings in found.items() for finding in findings]
    return {'ok': all(row['level'] != FAIL for row in rows), 'findings': rows,
            'meta': {'version': __version__, **meta}}


def _observed(listen, seconds, findings):
    """Observe the graph; None, with a finding appended, if ROS is missing or does not start."""
    try:
        return listen(seconds)
    except ModuleNotFoundError as error:
        finding = missing_library('ROS', error, 'ros')
        findings.append(replace(finding, remedy='source /opt/ros/jazzy/setup.bash, or '
                                f'{finding.remedy}, or --skip ros'))
    except (OSError, RuntimeError) as error:
        findings.append(Finding('ROS', FAIL, f"does not start: {' '.join(str(error).split())}",
                                'check RMW_IMPLEMENTATION and network; or --skip ros'))
    return None


def _print(console, found, skip):
    table = Table(*(Column(name, overflow='fold') for name in ('item', 'finding', '',
                                                               'what to do')),
                  title='Bring-up', title_justify='left')
    for part in PARTS:
        for finding in found.get(part, []):
            table.add_row(Text(finding.item), Text(finding.found),
                          Text(finding.level, STYLES[finding.level]), Text(finding.remedy))
        table.add_section()
    console.print(table)
    levels = [finding.level for rows in found.values() for finding in rows]
    failed, warned = levels.count(FAIL), levels.count(WARN)
    skipped = f"; not checked: {', '.join(skip)}" if skip else ''
    console.print(f'{failed} failed, {warned} warnings, {levels.count(OK)} ok{skipped}',
                  highlight=False, style=STYLES[FAIL if failed else WARN if warned else OK])
