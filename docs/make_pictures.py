"""
Fly and draw the pictures of the tutorials and of gap: ``python docs/make_pictures.py [NAME...]``.

Pictures are written to docs/tutorials/pictures/. Each takes up to a minute; ``hardware_flight``
needs ROS.
"""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys
import tempfile

import matplotlib
from matplotlib.figure import Figure
import numpy as np

import beetle_omni_ros as bo
from beetle_omni_ros.bags.log import motion
from beetle_omni_ros.identify.flights.page import picture_of
from beetle_omni_ros.model import rotations
from beetle_omni_ros.show.figures import COLOURS, FAINT, STYLE

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'docs' / 'tutorials' / 'pictures'
DOTS = 110      # per inch
POSE = 8.0      # [s] of a pose
TASK = 'random2'


def figure(columns, height=2.9):
    """Axes beside each other, and their figure."""
    drawn = Figure((8.0, height), layout='constrained')
    return drawn, np.atleast_1d(drawn.subplots(1, columns))


def flown(log, end=None):
    """Times since the first target [s], positions, quaternions and the targets' errors."""
    body, start = motion(log), log.targets[0].stamp
    keep = (body.t >= start) & (body.t <= start + (end or np.inf))
    rows = np.flatnonzero(keep)
    times = body.t[rows]
    position, angle = np.zeros((2, len(rows)))
    stamps = np.array([target.stamp for target in log.targets])
    for k, row in enumerate(rows):
        aim = log.targets[np.searchsorted(stamps, times[k], 'right') - 1].at(float(times[k]))
        position[k] = np.linalg.norm(body.position[row] - aim.position)
        angle[k] = rotations.geodesic_angle(body.quaternion[row], aim.quaternion)
    return times - start, body.position[rows], position, np.degrees(angle)


def named(axes, title, x, y):
    """Title and labels."""
    axes.set(title=title, xlabel=x, ylabel=y)


def drawn_errors(logs, title, end):
    """Position and attitude errors of several flights against time."""
    drawn, (left, right) = figure(2)
    for (label, log), colour in zip(logs.items(), COLOURS):
        times, _, position, angle = flown(log, end)
        left.semilogy(times, position, color=colour, label=label)
        right.semilogy(times, angle, color=colour, label=label)
    named(left, title, 'time [s]', 'distance from the target [m]')
    named(right, '', 'time [s]', 'angle to the target [deg]')
    left.legend()
    return drawn


def first_flight():
    """Errors of both controllers at the poses."""
    return drawn_errors({name: bo.simulate(name, TASK) for name in ('nmpc', 'rl')},
                        'Two random poses', 2 * POSE)


def blocks_of(page, language):
    """Blocks of a tutorial in a language."""
    text = (ROOT / 'docs' / 'tutorials' / f'{page}.md').read_text()
    return [part.partition('```')[0] for part in text.split(f'```{language}\n')[1:]]


def own_trajectory():
    """The circle of the tutorial from above, and the errors."""
    scope: dict = {}
    exec(blocks_of('own_trajectory', 'python')[0].partition('results =')[0], scope)
    drawn, (left, right) = figure(2, 3.2)
    for name, colour in zip(('nmpc', 'rl'), COLOURS):
        times, path, position, _ = flown(bo.simulate(name, scope['task']))
        on = times > POSE
        left.plot(path[on, 0], path[on, 1], color=colour, label=name)
        right.plot(times[on] - POSE, 1000 * position[on], color=colour, label=name)
    left.plot(*scope['positions'][:, :2].T, color=FAINT, linestyle=':', label='asked for')
    left.set_aspect('equal')
    left.legend()
    named(left, 'The path from above', 'x [m]', 'y [m]')
    named(right, 'Distance from the path', 'time [s]', 'error [mm]')
    return drawn


def own_controller():
    """Errors of the tutorial's two laws and of the NMPC."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / 'mine.py').write_text(blocks_of('own_controller', 'python')[0])
        return drawn_errors({
            label: bo.simulate(name, TASK) for label, name in (
                ('Mine', f'{folder}/mine.py:Mine'), ('Stiffer', f'{folder}/mine.py:Stiffer'),
                ('nmpc', 'nmpc'))}, 'Two random poses', 2 * POSE)


def own_robot():
    """Errors with the right file, the wrong one, and one with the right time constant."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'heavy.yaml').write_text(blocks_of('own_robot', 'yaml')[0])
        for command in blocks_of('own_robot', 'sh')[:2]:
            subprocess.run(['bash', '-ec', command], cwd=folder, check=True,
                           stdout=subprocess.DEVNULL)
        return drawn_errors({name: bo.read_run(folder / name)
                             for name in ('known', 'wrong', 'slow')}, 'Two poses', 2 * POSE)


def own_gap():
    """Error of the model, before and after, and the mass."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plant = folder / 'secret.yaml'
        plant.write_text('extends: robot.yaml\neffects: {mass: {mass: 3.3}}\n')
        for seed in (1, 2):
            bo.simulate('nmpc', 'random8', plant=plant, seed=seed, bag=folder / f'flight{seed}')
        found = bo.find_gap([folder / 'flight1'], holdout=[folder / 'flight2'])
    drawn, (left, right) = figure(2)
    bars = [found['gap_before'], found['gap_after'], found['noise_floor']]
    left.bar(['before', 'after', 'noise'], bars, color=[COLOURS[1], COLOURS[2], FAINT], width=0.6)
    named(left, 'Gap on the flight that judges', '', 'gap, in units of the noise')
    mass = found['effects'][0]['parameters']['mass']
    low, high = mass['interval']
    right.errorbar([mass['value']], [1], xerr=[[mass['value'] - low], [high - mass['value']]],
                   fmt='o', color=COLOURS[2], capsize=4, label='found, 95 % interval')
    right.plot([3.3], [1], 'x', color=COLOURS[1], markersize=9, label='true')
    right.plot([3.0386], [1], 's', color=FAINT, label='robot file')
    right.set(yticks=[], ylim=(0.8, 1.4))
    right.legend(loc='upper center')
    named(right, f"named: {', '.join(found['effects'][0]['names'])}", 'mass [kg]', '')
    return drawn


def real_gap():
    """Disagreement and sizes of three real flights, as on the page of `gap`."""
    return picture_of(bo.find_gap(
        sorted((ROOT / 'test/data/nanobench').glob('*.csv.gz')), form='nanobench',
        robot=ROOT / 'params' / 'crazyflie.yaml', quiet=True))


def hardware_flight():
    """Tilt angles and pack voltage of a flight through emulated devices."""
    from beetle_omni_ros.ros.fly import run_fly
    with tempfile.TemporaryDirectory() as name:
        poses = Path(name) / 'first.csv'
        poses.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0,0,1,0,0,0\n0,0,1.2,45,0,0\n')
        run_fly(task=str(poses), bag=Path(name) / 'bag', actuators='emulated')
        log = bo.read_run(Path(name) / 'bag')
    start = log.targets[0].stamp
    drawn, (left, right) = figure(2)
    for k, colour in enumerate(COLOURS[:4]):
        left.plot(log.joint.t - start, np.degrees(log.joint.position[:, k]), color=colour,
                  label=f'gimbal{k + 1}')
        left.plot(log.command.t - start, np.degrees(log.command.tilt[:, k]), color=colour,
                  linestyle=':')
    left.legend(ncols=2)
    left.set_xlim(6, 12)
    named(left, 'Tilt, measured (line) and asked for (dots)', 'time [s]', 'angle [deg]')
    right.plot(log.battery.t - start, log.battery.voltage, color=COLOURS[0])
    named(right, 'Pack', 'time [s]', 'voltage [V]')
    return drawn


PICTURES = {made.__name__: made for made in (first_flight, own_trajectory, own_controller,
                                             own_robot, own_gap, real_gap, hardware_flight)}


def main(names):
    """Draw the named pictures, all by default."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or PICTURES:
        with matplotlib.rc_context(STYLE):
            PICTURES[name]().savefig(FOLDER / f'{name}.png', dpi=DOTS,
                                     pil_kwargs={'optimize': True})
        print(FOLDER / f'{name}.png')


if __name__ == '__main__':
    main(sys.argv[1:])
