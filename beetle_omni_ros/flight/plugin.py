"""Components of others: a class in a file, for the loop and for the graph."""

from __future__ import annotations

from collections.abc import Iterable

from beetle_omni_ros.control.registry import loaded, snake_case
from beetle_omni_ros.flight.component import Component
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError


def component_class(reference: str) -> type[Component]:
    """
    Load a subclass of Component, whose constructor takes the robot.

    Raises:
        ParameterError: there is none at ``reference``, 'FILE.py:Class' or 'package.module:Class'.

    """
    found = loaded(reference)
    if not (isinstance(found, type) and issubclass(found, Component)):
        raise ParameterError(f"component '{reference}': {found!r} is no subclass of Component")
    return found


def node_name(kind: type[Component]) -> str:
    """Name of the node of a component: 'wrench_observer_node' of WrenchObserver."""
    return f'{snake_case(kind.__name__)}_node'


def made(references: Iterable[str], robot: RobotParameters) -> list[Component]:
    """Components of references; their topics are those of the table or registered ones."""
    return [component_class(reference)(robot) for reference in references]
