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

from beetle_omni_ros.show.page import Grid, print_grids


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
