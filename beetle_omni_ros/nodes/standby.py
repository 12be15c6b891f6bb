"""Which controllers a graph runs: the active one, and the other to be selected in flight."""

from __future__ import annotations

from pathlib import Path

from beetle_omni_ros.control.policy import DEFAULT
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

CONTROLLERS = ('nmpc', 'rl')     # that have a node


def controller_nodes(active: str, *, robot_file: str = '', policy: str = '',
                     allow_other_robot: bool = False, standby: bool = True
                     ) -> tuple[dict[str, dict], str]:
    """
    Give the controllers' nodes with their parameters.

    A policy that cannot fly this robot is left out when it would only stand by, because a node
    that refuses its parameters ends the process that it shares.

    Args:
        active: 'nmpc' or 'rl'.
        robot_file: what they believe; empty: the shipped one.
        policy: file for rl_node; empty: the shipped one.
        allow_other_robot: accept a policy that was trained for other robot parameters.
        standby: whether the other one runs too.

    Returns:
        Node name -> parameters, the active one first; why rl does not stand by, or ''.

    Raises:
        ParameterError: the active controller has no node, or its policy is not usable.

    """
    if active not in CONTROLLERS:
        raise ParameterError(f"controller '{active}': no node for it; expected "
                             f"{' or '.join(CONTROLLERS)}")
    robot = {'robot_file': robot_file} if robot_file else {}
    learnt = dict(robot)
    if policy:
        learnt['policy'] = str(Path(policy).absolute())
    if allow_other_robot:
        learnt['allow_other_robot'] = True
    nodes = {'nmpc_node': robot, 'rl_node': learnt}
    if active == 'rl':
        nodes = {'rl_node': learnt, 'nmpc_node': robot}
    if not standby:
        nodes = {f'{active}_node': nodes[f'{active}_node']}
    reason = unfit(policy, robot_file, allow_other_robot) if 'rl_node' in nodes else ''
    if reason and active == 'rl':
        raise ParameterError(reason)
    if reason:
        del nodes['rl_node']
    return nodes, reason


def unfit(policy: str = '', robot_file: str = '', allow_other_robot: bool = False) -> str:
    """Why a policy (empty: the shipped one) cannot fly a robot; '' when it can."""
    try:
        from beetle_omni_ros.control.policy_network import PolicyNetwork
        PolicyNetwork(policy or DEFAULT, RobotParameters.load(robot_file or None),
                      allow_other_robot)
    except (ParameterError, ImportError) as error:
        return str(error)
    return ''
