"""Reader of URDF files: links, their visible shapes, and their joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import xml.etree.ElementTree as ElementTree

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.resources import PACKAGE, share_path
from beetle_omni_ros.robot.schema import ParameterError

SHIPPED = 'description/beetle_omni.urdf'
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
GREY = (0.5, 0.5, 0.5, 1.0)
SHAPES = {'box': 'size', 'cylinder': 'radius length', 'sphere': 'radius'}
UNUSABLE = (ElementTree.ParseError, AttributeError, KeyError, TypeError, ValueError)


@dataclass(frozen=True)
class Joint:
    """Connection of a link to its parent."""

    name: str
    parent: str     # link names
    child: str
    position: np.ndarray    # (3,) of the child in the parent's frame at angle 0 [m]
    quaternion: np.ndarray  # (4,) likewise
    axis: np.ndarray | None = None  # (3,) of rotation in the child's frame; None if fixed

    def turned(self, angle: float) -> np.ndarray:
        """Quaternion (4,) of the child in the parent's frame at ``angle`` [rad]."""
        if self.axis is None:
            return self.quaternion
        return rotations.multiply(self.quaternion, rotations.exp(angle * self.axis))


@dataclass(frozen=True)
class Visual:
    """One visible shape of a link."""

    shape: str                  # 'box', 'cylinder', 'sphere' or 'mesh'
    size: tuple[float, ...]     # edges; radius and length; radius; scale of each axis [m, mesh: 1]
    position: np.ndarray        # (3,) in the link's frame [m]
    quaternion: np.ndarray      # (4,) likewise
    colour: tuple[float, ...] = GREY    # red, green, blue, opacity, each 0 to 1
    file: Path | None = None    # of a mesh


@dataclass(frozen=True)
class Link:
    """A link with its visible shapes."""

    name: str
    joint: Joint | None     # to its parent; None for the root
    visuals: tuple[Visual, ...] = ()

    @property
    def moves(self) -> str:
        """Name of its joint; '' if it is fixed."""
        return self.joint.name if self.joint is not None and self.joint.axis is not None else ''

    def turned(self, angle: float = 0.0) -> np.ndarray:
        """Quaternion of the link in its parent with the joint at ``angle`` [rad]."""
        return IDENTITY if self.joint is None else self.joint.turned(angle)


@dataclass(frozen=True)
class Model:
    """Links of a robot, parents before children."""

    links: dict[str, Link]
    limits: dict[str, tuple[float, float]]      # joint -> lower and upper [rad]

    @classmethod
    def load(cls, path: str | Path | None = None) -> Model:
        """
        Read a URDF file, by default the shipped one.

        Raises:
            ParameterError: one line; unreadable file or no URDF.

        """
        path = Path(path) if path else share_path(SHIPPED)
        text = description(path)
        try:
            root = ElementTree.fromstring(text)
            if root.tag != 'robot':
                raise ValueError(f'expected <robot>, found <{root.tag}>')
            return cls(_links(root, joints(text), path), _limits(root))
        except UNUSABLE as error:
            raise ParameterError(f'{path}: not a usable URDF: {error}') from None


def description(path: str | Path = '') -> str:
    """
    Text of a URDF file; '' for the shipped one.

    Raises:
        ParameterError: the file is unreadable.

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
        ParameterError: no URDF, or a joint that is neither fixed nor rotates about an axis.

    """
    try:
        root = ElementTree.fromstring(text)
        return [_joint(element) for element in root.findall('joint')]
    except UNUSABLE as error:
        raise ParameterError(f'robot description: not usable ({error})') from None


def _joint(element):
    kind, axis = element.get('type'), element.find('axis')
    if kind not in ('fixed', 'revolute', 'continuous'):
        raise ValueError(f"joint type '{kind}': expected fixed, revolute or continuous")
    position, quaternion = _origin(element)
    return Joint(element.attrib['name'], element.find('parent').attrib['link'],
                 element.find('child').attrib['link'], position, quaternion,
                 None if kind == 'fixed' else
                 _numbers('1 0 0' if axis is None else axis.attrib['xyz'], 3))


def _links(root, held, path):
    colours = {entry.get('name'): _colour(entry, {}) for entry in root.findall('material')}
    visuals = {link.get('name'): tuple(_visual(entry, colours, path)
                                       for entry in link.findall('visual'))
               for link in root.findall('link')}
    by_child = {joint.child: joint for joint in held}
    links = {name: Link(name, None, seen) for name, seen in visuals.items()
             if name not in by_child}
    if len(links) != 1:
        raise ValueError(f'expected one root link, found {len(links)}')
    while len(links) < len(visuals):
        following = {name: Link(name, joint, visuals[name]) for name, joint in by_child.items()
                     if joint.parent in links and name not in links}
        if not following:
            raise ValueError('links without a connection to the root')
        links.update(following)
    return links


def _limits(root):
    limits = {joint.get('name'): joint.find('limit') for joint in root.findall('joint')}
    return {name: (float(limit.get('lower')), float(limit.get('upper')))
            for name, limit in limits.items() if limit is not None and limit.get('upper')}


def _visual(entry, colours, path):
    position, quaternion = _origin(entry)
    geometry = entry.find('geometry')[0]
    material = entry.find('material')
    colour = GREY if material is None else _colour(material, colours)
    if geometry.tag == 'mesh':
        return Visual('mesh', tuple(_numbers(geometry.get('scale', '1 1 1'), 3)), position,
                      quaternion, colour, _mesh_file(geometry.get('filename'), path))
    size = ' '.join(geometry.get(key) for key in SHAPES[geometry.tag].split())
    return Visual(geometry.tag, tuple(map(float, size.split())), position, quaternion, colour)


def _mesh_file(name, urdf):
    place = name.removeprefix('file://')
    if place.startswith(f'package://{PACKAGE}/'):
        return share_path(place.removeprefix(f'package://{PACKAGE}/'))
    return urdf.parent / place


def _origin(entry):
    origin = entry.find('origin')
    if origin is None:
        return np.zeros(3), IDENTITY
    return (_numbers(origin.get('xyz', '0 0 0'), 3),
            rotations.from_rpy(*_numbers(origin.get('rpy', '0 0 0'), 3)))


def _colour(material, known):
    colour = material.find('color')
    if colour is None:
        return known.get(material.get('name'), GREY)
    return tuple(_numbers(colour.get('rgba'), 4))


def _numbers(text, count):
    numbers = np.array([float(part) for part in text.split()])
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {count} numbers, found '{text}'")
    return numbers
