"""Signals that end a flight: one line, a complete bag, no process left."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from beetle_omni_ros.nodes.runner import sigterm_as_interrupt
from beetle_omni_ros.runs.bag import read_bag


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_an_interrupt_even_if_a_library_converts_it(number):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), sigterm_as_interrupt():
        try:
            os.kill(os.getpid(), number)
            time.sleep(1)
        except KeyboardInterrupt:
            raise RuntimeError('context is not valid') from None
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(('moment', 'options'), [
    ('start', ('--separate', '--actuators', 'direct')), ('flight', ())])
def test_sigterm_ends_a_flight_cleanly_and_the_bag_is_complete(tmp_path, moment, options):
    bag, temporary = tmp_path / 'bag', tmp_path / 'tmp'
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.cli', 'fly', '--bag', str(bag), '--task', 'hover',
         '--clock', 'simulated', '--alone', *options],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'TMPDIR': str(temporary)})
    deadline = time.monotonic() + 120
    try:
        while not has_started(bag, b'flying:nmpc' if moment == 'flight' else b''):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert error.strip() == 'beetle_omni fly: interrupted; everything is stopped'
    assert process.returncode == 130
    assert not list(temporary.iterdir())
    if moment == 'flight':
        log = read_bag(bag)
        assert not log.warnings and 'flying:nmpc' in log.states
        assert log.meta['task'] == 'hover' and log.meta['interrupted']


def has_started(bag: Path, text: bytes):
    """Whether the recorder writes, and has written ``text``."""
    return any(text in file.read_bytes() for file in bag.glob('*.mcap'))
