"""The program `beetle_omni view`."""

import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
import urllib.request

from synthetic_flights import fly

from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.tasks import make_task

ROOT = Path(__file__).parents[2]


def test_the_viewer_prints_its_address_and_ends_with_ctrl_c(tmp_path):
    with BagWriter(tmp_path / 'flight') as writer:
        fly(writer, make_task('hover'), duration=4.0, start=50.0)
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view', str(tmp_path),
         '--port', str(port)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
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
