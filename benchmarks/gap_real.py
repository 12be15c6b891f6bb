"""
`gap --format` on real flights: what it names, and whether disjoint halves agree.

    .venv/bin/python benchmarks/gap_real.py FOLDER [--json FILE]

FOLDER has the flights of NanoBench in the columns of `params/formats/nanobench.yaml`, and
`labels.csv` with the columns file and vehicle. The flights of one build are divided into two
halves, alternately by name. Cases: the model of the literature; without the effect of voltage; and
the corrected model of the other half without each of its effects in turn.
"""

import argparse
import csv
import json
from pathlib import Path
import tempfile

from rich.console import Console
import yaml

from beetle_omni_ros.identify.gap.command import gap_results
from beetle_omni_ros.robot.resources import share_path

BUILD = 'NanoBench-state-A'
ROBOT = share_path('params/crazyflie.yaml')


def halves(folder):
    """Flights of the build with most flights, in two halves."""
    with open(folder / 'labels.csv', newline='', encoding='utf-8') as file:
        names = sorted(row['file'] for row in csv.DictReader(file) if row['vehicle'] == BUILD)
    paths = [folder / name for name in names]
    return paths[::2], paths[1::2]


def analysed(case, fitted, judging, robot, apply=None):
    """One row of the table."""
    result = gap_results(fitted, judging, robot, apply, form='nanobench',
                         console=Console(quiet=True))
    effects = [f"{' or '.join(e['names'])} " + ', '.join(
        f"{p['value']:.4g} [{p['interval'][0]:.4g}, {p['interval'][1]:.4g}]"
        for p in e['parameters'].values() if not isinstance(p['value'], list))
        for e in result['effects'] or result['partial']]
    row = {'case': case, 'verdict': result['verdict'], 'effects': effects,
           'false_alarm_probability': result['false_alarm_probability'],
           'gap_before': result['gap_before'], 'gap_after': result['gap_after'],
           'closure': result['closure'],
           'torque_used': result['groups']['torque']['used']}
    print(f"| {case} | {row['verdict']} | {'; '.join(effects)} | {row['gap_before']:.2f} | "
          f"{row['gap_after']:.2f} |", flush=True)
    return row


def main():
    """Run all cases and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--json', type=Path)
    given = parser.parse_args()
    one, two = halves(given.folder)
    print('| case | verdict | effects, 95 % | gap before | after |')
    print('| --- | --- | --- | --- | --- |')
    with tempfile.TemporaryDirectory() as folder:
        corrected, rows = Path(folder, 'corrected.yaml'), []
        bare = Path(folder, 'bare.yaml')
        bare.write_text(f'extends: {ROBOT}\neffects: {{}}\n')
        rows.append(analysed('literature, half 1', one, two, ROBOT, corrected))
        rows.append(analysed('literature, half 2', two, one, ROBOT))
        rows.append(analysed('without voltage, half 1', one, two, bare))
        rows.append(analysed('without voltage, half 2', two, one, bare))
        effects = yaml.safe_load(corrected.read_text())['effects']
        for name in effects:
            less = {other: values for other, values in effects.items() if other != name}
            robot = Path(folder, f'without_{name}.yaml')
            robot.write_text(yaml.safe_dump({'extends': str(ROBOT), 'effects': less}))
            rows.append(analysed(f'corrected by half 1 without {name}, half 2', two, one, robot))
        rows.append(analysed('corrected by half 1, half 2', two, one, corrected))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


if __name__ == '__main__':
    main()
