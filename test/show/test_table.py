"""Tables in the terminal: unbroken words, and a pipe whose reader has ended."""

import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console
from rotor_logs import bench, write

from beetle_omni_ros.bags.metrics import POSE_KEYS
from beetle_omni_ros.show.page import Grid, print_grids
from beetle_omni_ros.show.table import grids, print_results


@pytest.mark.parametrize('width', [40, 80, 200])
def test_a_printed_table_breaks_no_name_and_no_number(width):
    cells = [['voltage_sag', 'exponent [1]', '1.234', '1.1..1.4', '4123'],
             ['', 'loss_per_ampere_hour [1/(A h)]', '0.01234', '0.01111..0.02345', '0, 0, 0']]
    text = io.StringIO()
    print_grids([Grid('Effects', ['effect', 'parameter', 'value', '95 %', 'in the file'], cells)],
                Console(file=text, width=width))
    words = {word for row in cells for cell in row for word in cell.split()}
    assert words <= set(text.getvalue().split())
    # The words alone need 68 columns.
    assert max(map(len, text.getvalue().splitlines())) <= max(width, 68)


def test_a_command_whose_reader_has_ended_still_writes_its_files(tmp_path):
    log = write(tmp_path / 'bench.csv', bench(np.random.default_rng(0)))
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'identify', 'rotor',
         str(log), '--json', str(tmp_path / 'rotor.json')],
        stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, '')
    assert 'verdict' in json.loads((tmp_path / 'rotor.json').read_text())


def flown(controller, poses, **more):
    """Result of a flight with equal errors at all poses, the last one not reached."""
    errors = dict(zip(POSE_KEYS, (0.4321, 123.4, 1.234, 99.9), strict=True))
    return {'controller': controller, 'mean': errors, 'max': errors, 'alarms': {}, 'poses': [
        {'target': pose, **errors, 'reached': pose is not poses[-1]} for pose in poses], **more}


def test_three_runs_fit_80_columns_without_a_broken_pose_and_published_ones_have_their_order():
    poses = [[-1.25, 0.5, 1.0, -174.4, 3.0, -149.0], [0.0, -1.0, 1.5, 5.0, -90.0, 180.0]]
    bad = {'crashed': True, 'ended': 'landing: rotor2_lost at 5.1 s', 'landing': {
        'speed_m_s': 2.0, 'fell': True}, 'alarms': {'rotor2_lost': 5.0, 'b': 6.0, 'c': 7.0}}
    results = {'meta': {'task': 'waypoints'}, 'a': flown('rl', poses), 'b': flown('nmpc', poses),
               'c': flown('rl', poses, **bad)}
    short, = grids(results)
    assert short.header[4:] == ['published RL, real robot', 'published NMPC, real robot']
    assert len(short.rows) <= 8 and ['alarms', 'none', 'none', 'rotor2_lost, b +1', '–', '–'] \
        in short.rows
    results['meta']['task'] = 'random2'
    text = io.StringIO()
    print_results(results, Console(file=text, width=80), full=True)
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    cell = ' 0.4321 123'
    assert lines[-1].split() == ['2', *f'0.00 -1.00 1.50 5 -90 180{3 * (cell + " ✗")}'.split()]
