"""Helpers of the bring-up tests: limits, quick checks, findings by item."""

from dataclasses import replace

from board_bench import QUICK
from servo_bench import PATIENT

from beetle_omni_ros.drivers.device_checks import check_board, check_servos
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
__all__ = ['QUICK', 'ROBOT']


def by_item(findings):
    """Item -> finding; each item is unique, and each finding that is not ok has a remedy."""
    found = {finding.item: finding for finding in findings}
    assert len(found) == len(findings), [finding.item for finding in findings]
    for finding in findings:
        assert bool(finding.remedy) == (finding.level != 'ok'), finding
        assert finding.found and '\n' not in finding.found + finding.remedy, finding
    return found


def repeated(look, condition, attempts=8):
    """
    Repeat a check until ``condition(found)``, with a limit; return the last findings.

    Emulated devices are threads of this process. On a busy machine they may not run during one
    check.
    """
    for _ in range(attempts):
        found = look()
        if condition(found):
            break
    return found


def levels(found, *, without='ok'):
    return {item: finding.level for item, finding in found.items() if finding.level != without}


def servos(port, graph=None, **changes):
    parameters = replace(ServoBusParameters.load(), port=port, reply_time=PATIENT, **changes)
    return by_item(check_servos(parameters, ROBOT.joints, graph))


def board(port, graph=None, seconds=1.2, **changes):
    parameters = replace(MotorBoardParameters.load(), port=port, **changes)
    return by_item(check_board(parameters, ROBOT, seconds, graph))
