"""Drawings for docs/make_pictures.py, with names and numbers of the tree."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch
import numpy as np

import beetle_omni_ros as bo
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.ros.graph import NODES
from beetle_omni_ros.show.figures import AFTER, BEFORE, FAINT, GREY, INK, LINES, PARTS

ROOT = Path(__file__).resolve().parents[1]
DEVICE, NODE, FILE = '#eef1f5', 'white', '#f6f0e2'      # faces of boxes
SMALL = 7.6


def canvas(width, height):
    """A figure whose axes count tenths of an inch, the origin at the top left."""
    drawn = Figure((width / 10, height / 10), facecolor='white')
    axes = drawn.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0), aspect='equal')
    axes.axis('off')
    return drawn, axes


def box(axes, x, y, width, height, text, face=NODE, edge=GREY, **style):
    """A box with text in its middle."""
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle='round,pad=0,rounding_size=0.8',
                                  fc=face, ec=edge, lw=1.4))
    style = {'fontsize': 8.6, 'color': INK, 'ha': 'center', 'va': 'center', **style}
    axes.text(x + width / 2, y + height / 2, text, linespacing=1.35, **style)


def arrow(axes, points, text='', at=None, colour=INK, **style):
    """A line through points with a head at its end, and its label."""
    points = np.array(points, float)
    axes.plot(*points[:-1].T, color=colour, lw=1.3, solid_joinstyle='round')
    axes.add_patch(FancyArrowPatch(points[-2], points[-1], arrowstyle='-|>', mutation_scale=9,
                                   color=colour, lw=1.3, shrinkA=0, shrinkB=0))
    if text:
        style = {'fontsize': SMALL, 'ha': 'center', 'va': 'bottom', 'color': INK, **style}
        axes.text(*(points[:2].mean(axis=0) - (0, 0.5) if at is None else at), text, **style)


def topic(name):
    """A name that is in the table of topics."""
    return ALL[name].name


def node(name):
    """A name that is an executable of the package."""
    if name not in NODES:
        raise KeyError(name)
    return name


def architecture():
    """Nodes and topics of the graph, and what bags become."""
    drawn, axes = canvas(90, 49)
    box(axes, 1.5, 9, 15, 26, '', DEVICE)
    axes.text(9, 10.6, 'robot, or ' + node('sim_node'), fontsize=8.6, ha='center', weight='bold',
              va='center', color=INK)
    for y, name in ((12.5, 'MoCap'), (17.2, 'IMU'), (25, 'four tilt servos'),
                    (29.7, 'motor board, pack')):
        box(axes, 3, y, 12, 3.7, name, fontsize=8)
    box(axes, 27, 13, 11, 6, node('ekf_node'))
    box(axes, 48, 2, 14, 5, node('reference_node'))
    for y, name, colour in ((10.5, 'rl', LINES['rl'][0]), (15, 'nmpc', LINES['nmpc'][0])):
        box(axes, 48, y, 14, 3.7, node(f'{name}_node'), edge=colour, color=colour,
            weight='bold')
    box(axes, 48, 19.5, 14, 3.7, 'your controller', edge=FAINT, color=GREY)
    box(axes, 73.5, 12, 14.5, 8, node('supervisor_node') + '\ncheck, select, land')
    box(axes, 24, 25, 15, 3.7, node('joint_bridge_node'))
    box(axes, 24, 29.7, 15, 3.7, node('rotor_bridge_node'))
    arrow(axes, [(15, 14.35), (27, 14.35)], topic('mocap/pose'))
    arrow(axes, [(15, 18), (27, 18)], topic('imu/data_raw'))
    arrow(axes, [(38, 16), (43, 16)], topic('odom'))
    axes.plot([43, 43], [12.35, 21.35], color=INK, lw=1.3)
    for y in (12.35, 16.85, 21.35):
        arrow(axes, [(43, y), (48, y)])
    arrow(axes, [(55, 7), (55, 10.5)], f"{topic('target_pose')}, {topic('target_trajectory')}",
          (56, 9.3), ha='left')
    axes.plot([67, 67], [12.35, 21.35], color=INK, lw=1.3)
    for y in (12.35, 16.85, 21.35):
        axes.plot([62, 67], [y, y], color=INK, lw=1.3)
    arrow(axes, [(67, 16), (73.5, 16)], 'rl/command,\nnmpc/command', (67.6, 25), ha='left')
    axes.plot([80.7, 80.7, 43], [20, 29, 29], color=INK, lw=1.3)
    axes.text(60, 28.5, f"{topic('command')}: four tilts, four thrusts", fontsize=SMALL,
              ha='center', color=INK)
    axes.plot([43, 43], [26.85, 31.55], color=INK, lw=1.3)
    for y in (26.85, 31.55):
        arrow(axes, [(43, y), (39, y)])
        axes.add_patch(FancyArrowPatch((24, y), (15, y), arrowstyle='<|-|>', mutation_scale=9,
                                       color=INK, lw=1.3, shrinkA=0, shrinkB=0))
    axes.text(19.7, 26.3, 'DYNAMIXEL', fontsize=6.6, ha='center', color=INK)
    axes.text(19.7, 31, 'MAVLink', fontsize=6.6, ha='center', color=INK)
    axes.text(24, 36.4, f"back to controllers and supervisor: {topic('joint_states')}, "
              f"{topic('battery_state')}, states",
              fontsize=SMALL, color=GREY, ha='left')
    box(axes, 1.5, 41, 15, 5, node('recorder_node') + '\nrecords every topic', fontsize=8)
    box(axes, 22, 41, 12, 5, 'bag\nrosbag2, MCAP', FILE, fontsize=8)
    box(axes, 40, 41, 14, 5, 'report, view,\nevaluate', fontsize=8)
    box(axes, 58, 41, 12, 5, 'gap, identify', fontsize=8)
    box(axes, 75, 41, 13, 5, 'robot file\nparams/*.yaml', FILE, fontsize=8)
    arrow(axes, [(9, 35), (9, 41)])
    arrow(axes, [(16.5, 43.5), (22, 43.5)])
    arrow(axes, [(34, 43.5), (40, 43.5)])
    arrow(axes, [(28, 46), (28, 47.8), (64, 47.8), (64, 46)])
    arrow(axes, [(70, 43.5), (75, 43.5)])
    arrow(axes, [(84.5, 41), (84.5, 38)], 'model of\nevery node', (84.5, 37.6))
    return drawn


def real_flights():
    """What `gap` does with three real flights, with its numbers."""
    found = bo.find_gap(sorted((ROOT / 'test/data/nanobench').glob('*.csv.gz')), form='nanobench',
                        robot=ROOT / 'params' / 'crazyflie.yaml', quiet=True)
    worst = found['where'][0]
    named = [' or '.join(each['names']) for each in found['effects']]
    drawn, axes = canvas(90, 29)
    box(axes, 1.5, 2, 15, 8, 'three real flights\nposes, IMU, duty', FILE)
    box(axes, 1.5, 14, 15, 8, 'robot file\nof the literature', FILE)
    box(axes, 23, 8, 17, 8, '1  predict every reading\nbetween two poses')
    box(axes, 46, 8, 17, 8, '2  try ' + f"{len(found['candidates'])} effects,"
        '\nkeep what repeats')
    box(axes, 69, 8, 19.5, 8, '3  judge on the flight\nthat was not fitted')
    arrow(axes, [(16.5, 6), (20, 6), (20, 10.5), (23, 10.5)])
    arrow(axes, [(16.5, 18), (20, 18), (20, 13.5), (23, 13.5)])
    arrow(axes, [(40, 12), (46, 12)])
    arrow(axes, [(63, 12), (69, 12)])
    style = {'fontsize': SMALL, 'ha': 'center', 'va': 'top', 'linespacing': 1.4}
    axes.text(31.5, 17, f"{worst['channel']}: error\n{worst['excess']:.0f} times the noise",
              color=BEFORE, weight='bold', **style)
    axes.text(54.5, 17, '\n'.join(['named:', *named]), color=AFTER, weight='bold', **style)
    style['weight'] = 'bold'
    axes.text(79, 17, f"gap before {found['gap_before']:.1f}", color=BEFORE, **style)
    axes.text(79, 18.9, f"after {found['gap_after']:.1f}, noise {found['noise_floor']:.1f}",
              color=AFTER, **style)
    box(axes, 69, 1, 19.5, 4.2, 'corrected robot file, report', FILE, fontsize=8)
    arrow(axes, [(78.7, 8), (78.7, 5.2)])
    return drawn


def frames():
    """The robot from above, and one tilted rotor seen along its arm towards the centre."""
    robot = RobotParameters.load()
    rotors, scale = robot.rotors, 62.0
    drawn, axes = canvas(90, 42)
    centre, turn = np.array([21.0, 21.5]), np.array([[0, -1], [-1, 0]])   # x up, y left

    def seen(vector):
        return turn @ np.asarray(vector)[:2]

    for vector, name, at in (((1, 0), 'x, forward', (0, -1)), ((0, 1), 'y, left', (-1, -1))):
        end = centre + 15.5 * seen(vector)
        arrow(axes, [centre, end], colour=FAINT)
        axes.text(*(end + at), name, fontsize=SMALL, color=GREY, ha='center')
    for k, colour in enumerate(PARTS):
        hub = centre + scale * seen(rotors.positions[k])
        axes.plot(*np.stack([centre, hub]).T, color=INK, lw=3)
        axes.add_patch(Circle(hub, 4.6, fc='white', ec=colour, lw=1.6, zorder=3))
        angles = np.radians((20, 140) if rotors.spin[k] > 0 else (140, 20))
        first, last = (hub + 5.6 * seen((np.cos(a), np.sin(a))) for a in angles)
        bend = 0.55 if rotors.spin[k] > 0 else -0.55
        axes.add_patch(FancyArrowPatch(first, last, arrowstyle='-|>', mutation_scale=10, lw=1.6,
                                       color=colour, connectionstyle=f'arc3,rad={bend}'))
        axes.text(*hub, f'rotor{k + 1}\nspin {rotors.spin[k]:+.0f}', fontsize=7.4, ha='center',
                  va='center', color=colour, weight='bold')
        push = seen(np.cross(robot.tilt_axes[k], (0, 0, 1)))
        arrow(axes, [hub + 4.9 * push, hub + 8.4 * push], colour=INK)
    axes.text(21, 41, 'from above; black: push of a positive tilt', fontsize=SMALL, ha='center',
              color=GREY)
    hub, tilt = np.array([64.0, 31.0]), np.radians(35)
    push, up = np.array([-np.sin(tilt), -np.cos(tilt)]), np.array([0, -1.0])
    axes.plot([hub[0], hub[0]], [31, 13], color=FAINT, lw=1, ls=':')
    across = np.array([np.cos(tilt), -np.sin(tilt)])
    axes.plot(*np.stack([hub + 2 * push - 7 * across, hub + 2 * push + 7 * across]).T, color=INK,
              lw=3, solid_capstyle='round')
    axes.add_patch(Circle(hub, 1.1, fc='white', ec=INK, lw=1.6))
    axes.add_patch(Circle(hub, 0.3, fc=INK, ec=INK))
    arrow(axes, [hub + 2 * push, hub + 17 * push], colour=PARTS[0])
    axes.text(*(hub + 18.2 * push), 'thrust f', fontsize=9, color=PARTS[0], weight='bold',
              ha='right')
    axes.add_patch(FancyArrowPatch(hub + 11 * up, hub + 11 * push, arrowstyle='-|>', color=INK,
                                   mutation_scale=9, lw=1.2, connectionstyle='arc3,rad=0.2'))
    axes.text(58.2, 18.6, 'q > 0', fontsize=9, color=INK)
    axes.text(64, 12, 'up of base_link', fontsize=SMALL, color=GREY, ha='center')
    axes.text(64, 35, 'arm axis a, out of the page', fontsize=SMALL, color=GREY, ha='center')
    axes.text(64, 38, 'force = f (cos q up + sin q (a x up))', fontsize=8.6, ha='center',
              color=INK)
    axes.text(64, 41, 'one rotor, seen from outside along its arm', fontsize=SMALL, ha='center',
              color=GREY)
    return drawn


def wiring():
    """Power and data from the pack to rotors, servos and computers."""
    drawn, axes = canvas(90, 40)
    power, data = BEFORE, PARTS[0]
    box(axes, 2, 16, 12, 7, '6S pack\n25.2 V', FILE)
    box(axes, 21, 3, 15, 6, 'regulator, 12 V, 4 A\nservos', DEVICE)
    box(axes, 21, 11, 15, 6, 'regulator\ncomputer', DEVICE)
    box(axes, 21, 21, 15, 6, 'four ESCs', DEVICE)
    box(axes, 21, 31, 15, 6, 'motor board\nSTM32, 921600 bit/s', DEVICE)
    box(axes, 47, 3, 15, 6, 'four XC330-T181-T\none TTL chain', DEVICE)
    box(axes, 47, 21, 15, 6, 'four motors', DEVICE)
    box(axes, 70, 3, 17, 6, 'U2D2\n1 Mbit/s, no supply', DEVICE)
    box(axes, 70, 11, 17, 20, 'onboard computer\nUbuntu, ROS 2', NODE, INK, weight='bold')
    box(axes, 47, 11, 15, 6, 'IMU\n200 Hz, with its clock', DEVICE)
    box(axes, 70, 34, 17, 4.5, 'MoCap computer', DEVICE)
    for y in (6, 14, 24):
        arrow(axes, [(14, 19.5), (17.5, 19.5), (17.5, y), (21, y)], colour=power)
    arrow(axes, [(17.5, 24), (17.5, 34), (21, 34)], colour=power)
    arrow(axes, [(36, 6), (47, 6)], colour=power)
    arrow(axes, [(36, 18.6), (70, 18.6)], colour=power)
    axes.plot([28.5, 28.5, 36], [17, 18.6, 18.6], color=power, lw=1.3)
    arrow(axes, [(36, 24), (47, 24)], 'three phases', colour=power)
    arrow(axes, [(70, 6), (62, 6)], 'TTL', colour=data)
    arrow(axes, [(78.5, 11), (78.5, 9)], 'USB', (81, 10.6), colour=data)
    arrow(axes, [(62, 14), (70, 14)], 'USB', colour=data)
    arrow(axes, [(28.5, 31), (28.5, 27)], 'PWM, telemetry', (29.3, 29.6), colour=data, ha='left')
    arrow(axes, [(73, 31), (73, 32.6), (36, 32.6)], colour=data)
    axes.text(54, 32, 'USB or UART 3.3 V, MAVLink 2', fontsize=SMALL, ha='center', color=INK)
    arrow(axes, [(82, 34), (82, 31)], 'Ethernet', (82.8, 33.2), colour=data, ha='left')
    axes.text(47, 37.5, 'supply', color=power, fontsize=9, weight='bold')
    axes.text(56, 37.5, 'data', color=data, fontsize=9, weight='bold')
    axes.text(2, 27, 'all grounds meet\nat one point', fontsize=SMALL, color=GREY)
    return drawn
