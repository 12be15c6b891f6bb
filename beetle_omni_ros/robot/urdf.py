"""The tree of frames that a URDF describes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import xml.etree.ElementTree as ElementTree

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

SHIPPED = 'description/beetle_omni.urdf'


@dataclass(frozen=True)
class Joint:
    """
    How one link is held by another.

    Attributes:
        name: of the joint.
        parent, child: links.
        position, quaternion: (3,) [m], (4,) of the child in the parent's frame at angle 0.
        axis: (3,) about which it turns, in the child's frame; None where it is fixed.

    """

    name: str
    parent: str
    child: str
    position: np.ndarray
    quaternion: np.ndarray
    axis: np.ndarray | None = None

    def turned(self, angle: float) -> np.ndarray:
        """Quaternion (4,) of the child in the parent's frame at ``angle`` [rad]."""
        if self.axis is None:
            return self.quaternion
        return rotations.multiply(self.quaternion, rotations.exp(angle * self.axis))


def description(path: str | Path = '') -> str:
    """
    Text of a URDF; '' for the shipped one.

    Raises:
        ParameterError: it cannot be read.

    """
    path = path or share_path(SHIPPED)
    try:
        return Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f'{path}: cannot be read ({error})') from None


def joints(text: str) -> list[Joint]:
    """
    List the joints of a URDF.

    Raises:
        ParameterError: it is no URDF, or a joint is neither fixed nor turns about an axis.

    """
    try:
        root = ElementTree.fromstring(text)
        return [_joint(element) for element in root.findall('joint')]
    except (ElementTree.ParseError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ParameterError(f'robot description: not usable ({error})') from None


def _joint(element):
    kind, at, axis = element.get('type'), element.find('origin'), element.find('axis')
    if kind not in ('fixed', 'revolute', 'continuous'):
        raise ValueError(f"joint type '{kind}': expected fixed, revolute or continuous")
    place = {} if at is None else at.attrib
    return Joint(element.attrib['name'], element.find('parent').attrib['link'],
                 element.find('child').attrib['link'], _vector(place.get('xyz', '0 0 0')),
                 rotations.from_rpy(*_vector(place.get('rpy', '0 0 0'))),
                 None if kind == 'fixed' else
                 _vector('1 0 0' if axis is None else axis.attrib['xyz']))


def _vector(text):
    x, y, z = map(float, text.split())
    return np.array([x, y, z])
