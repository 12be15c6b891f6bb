"""The URDF describes the robot of params/robot.yaml."""

import importlib.util
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.sim.parameters import SimulatorParameters

ROBOT = RobotParameters.load()
URDF = share_path('description/beetle_omni.urdf')
TREE = ElementTree.parse(URDF).getroot()
LINKS = {link.get('name'): link for link in TREE.findall('link')}
JOINTS = {joint.get('name'): joint for joint in TREE.findall('joint')}


def vector(text):
    """Numbers of an attribute."""
    return np.array([float(word) for word in text.split()])


def transform(element):
    """Rotation (3, 3) and position of an element's origin."""
    at = element.find('origin')
    return (Rotation.from_euler('xyz', vector(at.get('rpy'))).as_matrix(), vector(at.get('xyz')))


def poses():
    """Link name -> (rotation, position) in base_link, joints at zero."""
    found = {'base_link': (np.eye(3), np.zeros(3))}
    while len(found) < len(LINKS):
        before = len(found)
        for joint in JOINTS.values():
            parent, child = joint.find('parent').get('link'), joint.find('child').get('link')
            if parent in found and child not in found:
                rotation, position = transform(joint)
                base, offset = found[parent]
                found[child] = base @ rotation, offset + base @ position
        assert len(found) > before, 'links without a joint to the tree'
    return found


def totals():
    """Mass, centre and inertia about base_link's origin of all links."""
    mass, first, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    for name, (rotation, position) in poses().items():
        part = LINKS[name].find('inertial')
        if part is None:
            continue
        m, (turn, centre) = float(part.find('mass').get('value')), transform(part)
        i = {key: float(value) for key, value in part.find('inertia').items()}
        local = np.array([[i['ixx'], i['ixy'], i['ixz']], [i['ixy'], i['iyy'], i['iyz']],
                          [i['ixz'], i['iyz'], i['izz']]])
        axes, r = rotation @ turn, position + rotation @ centre
        mass += m
        first += m * r
        inertia += axes @ local @ axes.T + m * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, first / mass, inertia


def test_totals_equal_those_of_the_robot_file():
    mass, centre, inertia = totals()
    assert mass == pytest.approx(ROBOT.mass, rel=1e-8)
    np.testing.assert_allclose(centre, 0, atol=1e-9)
    np.testing.assert_allclose(inertia, np.diag(ROBOT.inertia), atol=1e-9)


def test_gimbals_turn_about_their_arms_within_their_limits():
    placed = poses()
    for k, name in enumerate(JOINT_NAMES):
        joint = JOINTS[name]
        rotation, _ = placed[joint.find('child').get('link')]
        limit = joint.find('limit')
        assert joint.get('type') == 'revolute'
        np.testing.assert_allclose(rotation @ vector(joint.find('axis').get('xyz')),
                                   ROBOT.tilt_axes[k], atol=1e-8)
        assert float(limit.get('upper')) == -float(limit.get('lower')) \
            == ROBOT.joints.position_limit
        assert float(limit.get('velocity')) == ROBOT.joints.velocity_limit
        assert float(limit.get('effort')) == ROBOT.joints.effort_limit


def test_the_file_equals_the_output_of_the_generator():
    script = Path(__file__).parents[2] / 'description' / 'generate_urdf.py'
    if not script.is_file():
        pytest.skip('no source checkout')
    spec = importlib.util.spec_from_file_location('generate_urdf', script)
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    written = generator.urdf(ROBOT, SimulatorParameters.load())
    number = re.compile(r'-?\d+\.?\d*(?:e-?\d+)?')
    assert number.sub('#', URDF.read_text()) == number.sub('#', written)
    np.testing.assert_allclose([float(x) for x in number.findall(URDF.read_text())],
                               [float(x) for x in number.findall(written)], rtol=1e-6, atol=1e-9)


def test_every_mesh_is_shipped_closed_and_faces_outwards():
    trimesh = pytest.importorskip('trimesh')
    prefix = 'package://beetle_omni_ros/'
    names = {mesh.get('filename') for mesh in TREE.iter('mesh')}
    assert all(name.startswith(prefix) for name in names)
    assert {share_path(name.removeprefix(prefix)) for name in names} \
        == set(share_path('description/meshes').glob('*.stl'))
    for name in names:
        mesh = trimesh.load(share_path(name.removeprefix(prefix)))
        assert mesh.is_watertight and mesh.volume > 0, name
        assert np.abs(mesh.bounds).max() < 0.5, name


def test_feet_and_propellers_have_the_contact_geometry_of_the_plant():
    trimesh = pytest.importorskip('trimesh')
    plant = SimulatorParameters.load()
    placed = poses()
    lowest, widest = 0.0, 0.0
    for name, (rotation, position) in placed.items():
        for part in LINKS[name].findall('collision'):
            turn, at = transform(part)
            file = part.find('geometry/mesh').get('filename').rpartition('/')[2]
            points = trimesh.load(share_path(f'description/meshes/{file}')).vertices
            points = (points @ turn.T + at) @ rotation.T + position
            lowest = min(lowest, points[:, 2].min())
            widest = max(widest, np.hypot(points[:, 0], points[:, 1]).max())
    reach = np.hypot(*ROBOT.rotors.positions[:, :2].T).max() + plant.propeller_radius
    assert lowest == pytest.approx(-plant.foot_depth, abs=1e-6)
    assert reach - 0.005 < widest < reach + 1e-6
