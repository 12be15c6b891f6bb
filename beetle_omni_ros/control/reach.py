"""How far from the robot a target may be for each controller."""

from __future__ import annotations

from math import inf
from pathlib import Path

from beetle_omni_ros.control.base import Controller
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.robot.resources import share_path

PUBLISHED = 'params/nmpc_published.yaml'


def reach_of(controller: Controller) -> float:
    """Farthest target that a controller flies to [m]; inf where it does not say."""
    return float(getattr(controller, 'reach', inf))


def reach_of_name(name: str, nmpc_file: str | Path | None = None) -> float:
    """
    Look up the reach [m] of a controller by its name, without building it.

    Args:
        name: as in ``evaluate --controllers``; inf for one without a limit.
        nmpc_file: parameters of 'nmpc' in place of the shipped ones.

    Raises:
        ParameterError: an unusable file.

    """
    if name == 'nmpc':
        return NmpcParameters.load(nmpc_file).reach
    if name == 'nmpc_published':
        return NmpcParameters.load(share_path(PUBLISHED)).reach
    if name.startswith('rl'):
        from beetle_omni_ros.control.policy import PolicyParameters
        return PolicyParameters.load().reach
    return inf
