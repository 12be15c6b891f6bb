"""
Draw docs/images/robot.png: ``MUJOCO_GL=egl python docs/render_robot.py``.

The robot hovers in the published waypoints with the tilts and thrusts that each needs (green);
dots mark the way.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import hover_allocation
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.tasks import WAYPOINTS
from beetle_omni_ros.sim.render import Camera, Pose, render

DOT_SPACING = 0.06      # [m] of the path between waypoints
SUPERSAMPLING = 2       # drawn larger, for smooth shadow edges


def hovering(robot, position, quaternion):
    """The robot at rest in a pose."""
    hover = hover_allocation(robot, quaternion, np.zeros(4))
    return Pose(position, quaternion, hover.tilt, hover.thrust)


def main():
    """Render and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--output', type=Path,
                        default=Path(__file__).parent / 'images' / 'robot.png')
    parser.add_argument('--size', type=int, nargs=2, default=(1600, 900), help='pixels')
    given = parser.parse_args()
    robot = RobotParameters.load()
    poses = [hovering(robot, row[:3], rotations.from_rpy(*np.deg2rad(row[3:])))
             for row in WAYPOINTS[:4]]
    trail = [np.linspace(a.position, b.position, int(np.linalg.norm(b.position - a.position)
                                                     / DOT_SPACING))
             for a, b in zip(poses, [*poses[1:], poses[0]])]
    picture = render(robot, poses, Camera(), *(SUPERSAMPLING * size for size in given.size),
                     trail=np.concatenate(trail))
    given.output.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).resize(given.size, Image.Resampling.LANCZOS).save(
        given.output, optimize=True)


if __name__ == '__main__':
    main()
