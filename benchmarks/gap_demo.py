"""
The complete gap workflow, also as `make gap`: `python benchmarks/gap_demo.py`.

A plant has an effect that is not in the robot file. Three of its flights under the NMPC are
recorded, and `beetle_omni gap` analyses the bags. The robot file that it writes is tested by
a held-out flight, and by the lemniscate under the NMPC with the old and the corrected model. The
first effect is flown in real time through the ROS graph and both buses. The others use
`beetle_omni evaluate --bag`, which is the same loop and faster, on all cores.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import shutil
import sys

import joblib
import numpy as np
from rich.console import Console
from rich.table import Column, Table

from beetle_omni_ros.evaluation.command import run_evaluate
from beetle_omni_ros.identify.gap.command import gap_results
from beetle_omni_ros.robot.resources import share_path

# Hidden effects of typical size or somewhat larger, so that they affect the NMPC.
HIDDEN = {
    'tilt_thrust_loss': 'tilt_thrust_loss: {loss_at_60deg: 0.08}',
    'rotor_drag': 'rotor_drag: {coefficient: 1.2}',
    'joint_command_latency': 'joint_command_latency: {delay: 0.045}',
}
WIDTH = 120                 # columns that the table needs
FLIGHTS, POSES = 3, 7       # poses of 8 s; the last flight is held out


def poses(path: Path, seed: int) -> Path:
    """Write a task of random poses with large rotations, clear of the ground."""
    random = np.random.default_rng(seed)
    rows = ['x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg']
    for _ in range(POSES):
        place = random.uniform([-1.5, -1.5, 1.0], [1.5, 1.5, 2.0])
        turn = random.uniform([-150, -80, -180], [150, 80, 180])
        rows.append(','.join(f'{value:.2f}' for value in (*place, *turn)))
    path.write_text('\n'.join(rows) + '\n')
    return path


def plant_file(folder: Path, name: str) -> Path:
    """Write the robot with the hidden effect."""
    plant = folder / f'{name}_plant.yaml'
    plant.write_text(f"extends: {share_path('params/robot.yaml')}\neffects: {{{HIDDEN[name]}}}\n")
    return plant


def record(folder: Path, name: str, k: int, through_ros: bool = False) -> None:
    """Fly and record a flight of the plant with the effect ``name``."""
    bag, task = folder / f'{name}_{k}', folder / f'poses_{k}.csv'
    shutil.rmtree(bag, ignore_errors=True)
    given = {'task': str(task), 'plant': folder / f'{name}_plant.yaml', 'bag': bag, 'seed': k - 1,
             'console': Console(quiet=True)}
    if through_ros:
        from beetle_omni_ros.nodes.fly import run_fly
        if run_fly(**given):
            sys.exit(f'{name}: flight {k} failed')
    else:
        run_evaluate(controllers=['nmpc'], **given)


def lemniscate(plant: Path, model: Path) -> float:
    """Mean position error of the NMPC on the lemniscate [m]; nan after a crash."""
    found = run_evaluate(controllers=['nmpc'], task='lemniscate', plant=plant, robot=model,
                         console=Console(quiet=True))['nmpc']
    return float('nan') if found['crashed'] else found['trajectory']['position_mean_m']


def on_all_cores(calls: dict, console: Console) -> dict:
    """Results by the names of ``calls``, whose progress is printed."""
    def named(name, function, arguments):
        return name, function(*arguments)

    results, flights = {}, joblib.Parallel(n_jobs=-1, return_as='generator_unordered')(
        joblib.delayed(named)(name, *call) for name, call in calls.items())
    for name, result in flights:
        console.print(f'{name}: flown')
        results[name] = result
    return results


def show(names: list[str], folder: Path, through_ros: bool, console: Console) -> dict:
    """Analyse each hidden effect from flights to the corrected model; return results by name."""
    plants = {name: plant_file(folder, name) for name in names}
    corrected = {name: folder / f'{name}_robot.yaml' for name in names}
    numbers = range(1, FLIGHTS + 1)
    for k in numbers:
        poses(folder / f'poses_{k}.csv', 99 + k)
    if through_ros:     # alone on the computer: in real time
        for k in numbers:
            console.print(f'{names[0]}: flight {k} of {FLIGHTS}, in real time through ROS')
            record(folder, names[0], k, True)
    shipped = share_path('params/robot.yaml')
    flown = on_all_cores({
        **{f'{name}: lemniscate': (lemniscate, (plants[name], shipped)) for name in names},
        **{f'{name}: flight {k} of {FLIGHTS}': (record, (folder, name, k))
           for name in names[1 if through_ros else 0:] for k in numbers}}, console)
    results = {}
    for name in names:
        corrected[name].unlink(missing_ok=True)
        *fitted, judge = [folder / f'{name}_{k}' for k in numbers]
        found = gap_results(fitted, [judge], None, corrected[name], folder / f'{name}_gap.json',
                            folder / f'{name}_gap.html', console)
        results[name] = {
            'hidden': HIDDEN[name], 'verdict': found['verdict'],
            'named': [' or '.join(effect['names']) for effect in found['effects']],
            'parameters': [effect['parameters'] for effect in found['effects']],
            'gap_before': found['gap_before'], 'gap_after': found['gap_after'],
            'closure': found['closure'], 'through_ros': through_ros and name == names[0],
            'lemniscate_before_m': flown[f'{name}: lemniscate'],
            'lemniscate_after_m': float('nan')}
    again = on_all_cores({f'{name}: lemniscate with what was found':
                          (lemniscate, (plants[name], corrected[name]))
                          for name in names if corrected[name].exists()}, console)
    for call, error in again.items():
        results[call.split(':')[0]]['lemniscate_after_m'] = error
    return results


def main():
    """Analyse each effect and print a table; exit status 1 if one was not named."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('--effects', default=','.join(HIDDEN), help='default: all')
    arguments.add_argument('--no-ros', action='store_true', help='no flights in real time')
    arguments.add_argument('--output', type=Path, default=Path('runs_out/gap'))
    given = arguments.parse_args()
    names = given.effects.split(',')
    if unknown := set(names) - set(HIDDEN):
        arguments.error(f"unknown effect {', '.join(sorted(unknown))}; known: {', '.join(HIDDEN)}")
    given.output.mkdir(parents=True, exist_ok=True)
    console = Console()
    results = show(names, given.output, not given.no_ros, console)
    table = Table(Column('hidden', no_wrap=True), Column('named', overflow='fold'),
                  'gap before', 'after', 'closure', 'lemniscate before [mm]', 'after [mm]')
    for result in results.values():
        numbers = (result['gap_before'], result['gap_after'], result['closure'])
        table.add_row(result['hidden'].replace(': {', ' ').rstrip('}'),
                      ', '.join(result['named']) or result['verdict'],
                      *('–' if n is None else f'{n:.2f}' for n in numbers),
                      f"{1e3 * result['lemniscate_before_m']:.1f}",
                      f"{1e3 * result['lemniscate_after_m']:.1f}")
    Console(width=max(console.width, WIDTH)).print(table)
    (given.output / 'results.json').write_text(json.dumps(results, indent=1) + '\n')
    console.print(f'pages and robot files: {given.output}')
    found = [name in ' '.join(result['named']) for name, result in results.items()]
    sys.exit(0 if all(found) else 1)


if __name__ == '__main__':
    main()
