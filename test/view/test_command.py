"""`beetle_omni view`: refusals in one line, and the program."""

import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import urllib.request

import pytest
from synthetic_flights import fly

from beetle_omni_ros import cli
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.tasks import make_task

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('view') / 'flight'
    with BagWriter(folder) as writer:
        fly(writer, make_task('hover'), duration=4.0, start=50.0)
    return folder


@pytest.mark.parametrize('arguments, message', [
    (['BAG', 'none'], 'none: no such bag'), (['BAG', '--allow-targets'], '--allow-targets'),
    (['BAG', '--host', '300.1.1.1'], '--host 300.1.1.1')])
def test_unusable_input_is_one_line_and_status_2(bag, tmp_path, monkeypatch, capfd, arguments,
                                                 message):
    monkeypatch.chdir(tmp_path)
    given = [str(bag) if argument == 'BAG' else argument for argument in arguments]
    assert cli.main(['view', *given]) == 2
    captured = capfd.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1 and message in lines[0], captured
    assert not captured.out


def test_the_viewer_prints_its_address_and_ends_with_ctrl_c(bag):
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view', str(bag),
         '--port', '8420'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    try:
        line = process.stdout.readline()
        url = re.match(r'http://localhost:\d+', line)
        assert url, line
        with urllib.request.urlopen(url.group().replace('localhost', '127.0.0.1')) as answer:
            assert b'<html' in answer.read(500).lower()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        assert process.stdout.read() == process.stderr.read() == ''
    finally:
        process.kill()
