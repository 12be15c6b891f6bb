"""Executables end without a traceback if interrupted while their modules load."""

from pathlib import Path
import random
import signal
import subprocess
import sys
import time

ROOT = Path(__file__).resolve().parents[1]


def test_an_interrupt_at_a_random_moment_shows_no_traceback():
    moments = random.Random(3)
    statuses = set()
    for _ in range(8):
        process = subprocess.Popen(
            [sys.executable, '-c', 'import sys; from beetle_omni_ros.start import beetle_omni\n'
             'sys.stdout.write("begun\\n"); sys.stdout.flush()\n'
             'sys.argv = ["beetle_omni", "report", "/does/not/exist"]; sys.exit(beetle_omni())'],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
        assert process.stdout.readline() == 'begun\n'
        time.sleep(moments.uniform(0.02, 0.6))
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
        assert 'Traceback' not in error
        statuses.add(process.returncode)
    assert statuses <= {-signal.SIGINT, 130, 2} and -signal.SIGINT in statuses


def test_few_modules_are_loaded_before_interrupts_are_handled():
    loaded = subprocess.run(
        [sys.executable, '-S', '-c', 'import sys; before = set(sys.modules)\n'
         'import beetle_omni_ros.start; print(*sorted(set(sys.modules) - before))'],
        capture_output=True, text=True, timeout=60, check=True, cwd=ROOT).stdout.split()
    assert {'numpy', 'typing', 'pathlib', 'logging'}.isdisjoint(loaded)
    assert len(loaded) < 30, loaded
