"""
Fly and draw the films of the pages: ``python benchmarks/film.py``, which `make film` calls.

The first film shows both controllers at the published waypoints and inverted. The second one shows
a flight of a robot with a weak rotor, with the predictions of the model before and after `gap`.
"""

import argparse
from pathlib import Path
import shutil
import subprocess
import sys

from gap_demo import poses
import numpy as np
from rich.console import Console

from beetle_omni_ros.evaluation.command import run_evaluate
from beetle_omni_ros.identify.gap.command import gap_results
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.runs.tasks import pose_target, Segment, Task, WAYPOINTS

UPSIDE_DOWN = (0.0, 0.0, 1.0, 180.0, 0.0, 90.0)
# Pose: x, y, z [m], roll, pitch, yaw [deg], and its duration [s].
LEGS = [(WAYPOINTS[0], 1.2), *((pose, 2.7) for pose in WAYPOINTS[1:]), (UPSIDE_DOWN, 4.0),
        (WAYPOINTS[0], 4.0)]
CONTROLLERS = {'RL policy': 'rl', 'NMPC': 'nmpc'}
WEAK_ROTOR = 'effects: {rotor_thrust_coefficient: {scale: [1.0, 1.0, 0.95, 1.0]}}'
LEARNT = 3                      # flights from which gap learns


def task() -> Task:
    """Twenty seconds through the waypoints, upside down and back."""
    return Task('film', 'poses', tuple(
        Segment(duration, lambda start, pose=pose: pose_target(np.array(pose), start))
        for pose, duration in LEGS), np.array([pose for pose, _ in LEGS]))


def fly(folder: Path, name: str, controller: str, **given) -> Path:
    """Record one flight; an existing bag is replaced."""
    shutil.rmtree(folder / name, ignore_errors=True)
    run_evaluate(controllers=[controller], bag=folder / name, console=Console(quiet=True), **given)
    return folder / name


def draw(*arguments) -> None:
    """Call `beetle_omni film` in its own process, because MuJoCo chooses its OpenGL once."""
    done = subprocess.run([sys.executable, '-m', 'beetle_omni_ros.cli', 'film',
                           *map(str, arguments)])
    if done.returncode:
        sys.exit(done.returncode)


def find_gap(folder: Path, plant: Path, console: Console) -> Path:
    """Identify the hidden effect by `gap`; return the corrected robot file."""
    corrected = folder / 'corrected_model.yaml'
    corrected.unlink(missing_ok=True)
    runs = [fly(folder, f'gap_{k}', 'nmpc', plant=plant, seed=k,
                task=str(poses(folder / f'poses_{k}.csv', 100 + k))) for k in range(LEARNT)]
    gap_results(runs, apply=corrected, page=folder / 'gap.html', console=console)
    return corrected


def main():
    """Fly, draw and save."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--bags', type=Path, default=Path('runs_out/film'))
    parser.add_argument('--output', type=Path, default=Path('docs/pictures'))
    given = parser.parse_args()
    folder, console = given.bags, Console()
    folder.mkdir(parents=True, exist_ok=True)
    given.output.mkdir(parents=True, exist_ok=True)
    console.print('fly')
    bags = [fly(folder, name, controller, task=task()) for name, controller in
            CONTROLLERS.items()]
    draw(*bags, '-o', given.output / 'flight.gif')
    old, plant = folder / 'old_model.yaml', folder / 'plant.yaml'
    base = f"extends: {share_path('params/robot.yaml')}\n"
    old.write_text(base)
    plant.write_text(f'{base}{WEAK_ROTOR}\n')
    console.print('fly the robot with a weak rotor, find the gap')
    measured = fly(folder, 'weak rotor', 'nmpc', task=task(), plant=plant)
    corrected = find_gap(folder, plant, Console(quiet=True))
    draw(measured, '--model', old, '--model', corrected, '-o', given.output / 'gap.gif')


if __name__ == '__main__':
    main()
