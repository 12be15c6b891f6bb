"""Reader of the shipped URDF: links, their meshes, and their joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import xml.etree.ElementTree as ElementTree

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.resources import PACKAGE, share_path

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Joint:
    """Connection of a link to its parent."""

    name: str
    parent: str     # link names
    child: str
    position: np.ndarray    # (3,) of the child in the parent's frame at angle 0 [m]
    quaternion: np.ndarray  # (4,) likewise
    axis: np.ndarray | None     # (3,) of rotation in the child's frame; None if fixed

    def turned(self, angle: float) -> np.ndarray:
        """Quaternion (4,) of the child in the parent's frame at ``angle`` [rad]."""
        if self.axis is None:
            return self.quaternion
        return rotations.multiply(self.quaternion, rotations.exp(angle * self.axis))


@dataclass(frozen=True)
class Link:
    """A link with its visible shapes."""

    name: str
    joint: Joint | None     # to its parent; None for the root
    # Files of meshes, or radius and length of cylinders along z [m]; red, green, blue, opacity.
    shapes: list[tuple[Path | tuple[float, float], tuple[float, ...]]]

    @property
    def moves(self) -> str:
        """Name of its joint; '' if it is fixed."""
        return self.joint.name if self.joint is not None and self.joint.axis is not None else ''

    def turned(self, angle: float = 0.0) -> np.ndarray:
        """Quaternion of the link in its parent with the joint at ``angle`` [rad]."""
        return IDENTITY if self.joint is None else self.joint.turned(angle)


def description() -> str:
    """Text of the URDF."""
    return share_path('description/beetle_omni.urdf').read_text()


def joints() -> list[Joint]:
    """All joints."""
    return [_joint(element) for element in _root().iter('joint')]


def links() -> list[Link]:
    """All links, parents before children."""
    by_child = {joint.child: joint for joint in joints()}
    return [Link(name, by_child.get(name), shapes) for name, shapes in _shapes(_root())]


def _root():
    return ElementTree.fromstring(description())


def _joint(element):
    origin, axis = element.find('origin'), element.find('axis')
    return Joint(element.get('name'), element.find('parent').get('link'),
                 element.find('child').get('link'), np.array(_numbers(origin.get('xyz'))),
                 rotations.from_rpy(*_numbers(origin.get('rpy'))),
                 None if axis is None else np.array(_numbers(axis.get('xyz'))))


def _shapes(root):
    """Yield names and shapes of the links."""
    colours = {material.get('name'): _numbers(material.find('color').get('rgba'))
               for material in root.findall('material')}
    for link in root.findall('link'):
        yield link.get('name'), [
            (_shape(visual.find('geometry')[0]), colours[visual.find('material').get('name')])
            for visual in link.findall('visual')]


def _shape(element):
    if element.tag == 'cylinder':
        return float(element.get('radius')), float(element.get('length'))
    return share_path(element.get('filename').removeprefix(f'package://{PACKAGE}/'))


def _numbers(text):
    return tuple(map(float, text.split()))
