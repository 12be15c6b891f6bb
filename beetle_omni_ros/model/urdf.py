"""Reader of the shipped URDF: links, their places and their meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
import xml.etree.ElementTree as ElementTree

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.resources import PACKAGE, share_path


@dataclass(frozen=True)
class Link:
    """A link with its place in its parent and its visible shapes."""

    name: str
    parent: str     # a link; '' of the root
    joint: str      # that turns it; '' if it is fixed
    position: np.ndarray    # (3,) in the parent's frame at angle 0 [m]
    quaternion: np.ndarray  # (4,) likewise
    axis: np.ndarray        # (3,) of rotation in the link's frame; zero if it is fixed
    # Files of meshes, or radius and length of cylinders along z [m]; red, green, blue, opacity.
    shapes: list[tuple[Path | tuple[float, float], tuple[float, ...]]]

    def turned(self, angle: float) -> np.ndarray:
        """Quaternion (4,) in the parent's frame at ``angle`` [rad]."""
        return rotations.multiply(self.quaternion, rotations.exp(angle * self.axis))


def description() -> str:
    """Text of the URDF."""
    return share_path('description/beetle_omni.urdf').read_text()


def links() -> list[Link]:
    """All links, parents before children."""
    root: Any = ElementTree.fromstring(description())
    colours = {material.get('name'): _numbers(material.find('color'), 'rgba')
               for material in root.findall('material')}
    joints = {joint.find('child').get('link'): joint for joint in root.iter('joint')}
    found = []
    for link in root.findall('link'):
        joint = joints.get(link.get('name'), ElementTree.Element('joint'))
        parent, origin, axis = map(joint.find, ('parent', 'origin', 'axis'))
        found.append(Link(
            link.get('name'), '' if parent is None else parent.get('link'),
            '' if axis is None else joint.get('name'), np.array(_numbers(origin, 'xyz')),
            rotations.from_rpy(*_numbers(origin, 'rpy')), np.array(_numbers(axis, 'xyz')),
            [(_shape(visual.find('geometry')[0]), colours[visual.find('material').get('name')])
             for visual in link.findall('visual')]))
    return found


def _shape(element):
    if element.tag == 'cylinder':
        return float(element.get('radius')), float(element.get('length'))
    return share_path(element.get('filename').removeprefix(f'package://{PACKAGE}/'))


def _numbers(element, name):
    """Numbers of an attribute; zeros of an element that is missing."""
    return (0.0,) * 3 if element is None else tuple(map(float, element.get(name).split()))
