"""
`gap --format` on real flights: what it names, and whether disjoint halves agree.

    .venv/bin/python benchmarks/gap_real.py FOLDER [--crazypad]

FOLDER has the flights of NanoBench in the columns of `params/formats/nanobench.yaml`, and
`labels.csv` with the columns file and vehicle. The flights of one build are divided into two
halves, alternately by name. Cases: the model of the literature; without the effect of voltage; and
the corrected model of the other half without each of its effects in turn.

With `--crazypad`: the logs of the motors of CrazyPAD (`labels.csv` with cause and vehicle), single
flights, all sets of two and three of one cause and vehicle, and single flights against files whose
centre of mass is that of a normal flight of the same vehicle. `right`: every set of names holds
the cause. A normal flight has none, and a load is a mass and moves the centre of mass.
"""

import argparse
import csv
from itertools import combinations, groupby
from pathlib import Path
import tempfile

import numpy as np
from rich.console import Console
import yaml

from beetle_omni_ros.identify.flights.balance import Balance, SLOW
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.keys import keys_of
from beetle_omni_ros.identify.flights.verdict import load_tables
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path

BUILD = 'NanoBench-state-A'
ROBOT = share_path('params/crazyflie.yaml')


def labels(folder):
    """Rows of the table of the flights, by name of the file."""
    with open(folder / 'labels.csv', newline='', encoding='utf-8') as file:
        return sorted(csv.DictReader(file), key=lambda row: row['file'])


def sizes(effects):
    """Names and scalar sizes of effects in one line."""
    return '; '.join(' or '.join(effect['members']) + ' ' + ', '.join(
        f"{p['value']:.4g} [{p['interval'][0]:.4g}, {p['interval'][1]:.4g}]"
        for p in effect['parameters'].values() if not isinstance(p['value'], list))
        for effect in effects)


def analysed(case, fitted, judging, robot, apply=None):
    """One row of the table of NanoBench."""
    result = gap_results(fitted, judging, robot, apply, form='nanobench',
                         console=Console(quiet=True))
    print(f"| {case} | {result['verdict']} | {sizes(result['effects'] or result['partial'])} | "
          f"{result['gap_before']:.2f} | {result['gap_after']:.2f} |", flush=True)


def nanobench(folder):
    """One row for each case."""
    paths = [folder / row['file'] for row in labels(folder) if row['vehicle'] == BUILD]
    one, two = paths[::2], paths[1::2]
    print('| case | verdict | effects, 95 % | gap before | after |')
    print('| --- | --- | --- | --- | --- |')
    with tempfile.TemporaryDirectory() as temporary:
        def robot(name, effects):
            path = Path(temporary, f'{name}.yaml')
            path.write_text(yaml.safe_dump({'extends': str(ROBOT), 'effects': effects}))
            return path

        corrected, bare = Path(temporary, 'corrected.yaml'), robot('bare', {})
        analysed('literature, half 1', one, two, ROBOT, corrected)
        analysed('literature, half 2', two, one, ROBOT)
        analysed('without voltage, half 1', one, two, bare)
        analysed('without voltage, half 2', two, one, bare)
        effects = yaml.safe_load(corrected.read_text())['effects']
        for name in effects:
            analysed(f'corrected by half 1 without {name}, half 2', two, one, robot(
                name, {other: values for other, values in effects.items() if other != name}))
        analysed('corrected by half 1, half 2', two, one, corrected)


def holding(cause):
    """Labels of entries that may stand for a cause of CrazyPAD: M3 is rotor 3."""
    rotors = {f'rotor_thrust_coefficient[{word[1]}]' for word in cause.split('_')
              if word[:1] == 'M' and word[1:].isdigit()}
    if cause.startswith('cut'):
        return rotors
    return rotors | {'mass', 'centre_of_mass'} if 'weight' in cause else set()


def crazypad(folder):
    """One row for each set of flights: cause, names, and whether they hold the cause."""
    flights = sorted((row['vehicle'], row['cause'], folder / row['file'])
                     for row in labels(folder) if row['file'].startswith('pad_motor'))
    print('| cause | flights | reference | verdict | effects, 95 % | probability | |')
    print('| --- | --- | --- | --- | --- | --- | --- |')
    with tempfile.TemporaryDirectory() as temporary:
        robots = {'': ROBOT} | {
            f'{vehicle} {path.name}': centred(path, Path(temporary, f'{path.stem}.yaml'))
            for vehicle, cause, path in flights if cause == 'normal_flight'}
        for (vehicle, cause), group in groupby(flights, key=lambda flight: flight[:2]):
            paths = [path for *_, path in group]
            sets = [(chosen, '') for size in (1, 2, 3) for chosen in combinations(paths, size)]
            sets += [((path,), name) for path in paths for name in robots if name.startswith(
                vehicle) and not name.endswith(path.name)]
            for chosen, name in sets:
                weighed(vehicle, cause, chosen, robots[name], name)


def centred(path, to):
    """Robot file with the centre of mass that balances a flight."""
    robot = RobotParameters.load(ROBOT)
    flight, = load_tables([path], robot, Format.load('crazypad_motor'))
    found = Balance([flight.balance(list(keys_of(robot, SLOW)))], robot)
    own = [found.index[name] for name in ('centre_of_mass.offset[0]', 'centre_of_mass.offset[1]',
                                          'rotor_hub_moment.coefficient')]
    x, y, _ = np.linalg.solve(found.info[np.ix_(own, own)], found.right[own]).tolist()
    to.write_text(f'extends: {ROBOT}\neffects:\n  voltage_sag: {{exponent: 1.0}}\n'
                  f'  centre_of_mass: {{offset: [{x}, {y}, 0.0]}}\n')
    return to


def weighed(vehicle, cause, paths, robot, reference):
    """One row of the table of CrazyPAD."""
    result = gap_results(paths, [], robot, form='crazypad_motor', console=Console(quiet=True))
    effects, right = result['effects'], holding(cause)
    score = 'undecided' if not effects else 'right' if all(
        set(effect['members']) & right for effect in effects) else 'wrong'
    print(f"| {cause} {vehicle[-2:]} | {len(paths)} | {reference} | {result['verdict']} | "
          f"{sizes(effects)} | {result['false_alarm_probability']:.2g} | {score} |", flush=True)


def main():
    """Run all cases and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--crazypad', action='store_true')
    given = parser.parse_args()
    (crazypad if given.crazypad else nanobench)(given.folder)


if __name__ == '__main__':
    main()
