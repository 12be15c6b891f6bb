"""How far from the robot a target may be for each controller."""

from __future__ import annotations

from math import inf

from beetle_omni_ros.control.base import Controller


def reach_of(controller: Controller) -> float:
    """Farthest target that a controller flies to [m]; inf where it does not say."""
    return float(getattr(controller, 'reach', inf))
