"""
Cost of the viewer: ``python benchmarks/viewer.py [RUN] [--seconds 24] [--rounds 6]``.

Two parts, best on a computer that does nothing else:

- Flights of the same poses without viewer, with it, and with a connected browser, in rounds of
  three in rotating order: latency from the stamp of an IMU sample to its command at the
  actuators, and CPU of all nodes. The noise is the range of the flights without viewer.
- Playback of RUN, a long bag: time from the command to the first picture in a headless browser,
  then scene updates and drawn pictures a second, and CPU of reader, server and browser. The
  browser draws without a GPU.

Without RUN, a bag of 13 minutes is flown first, in simulated time, and kept in runs_out/.
"""

import argparse
from contextlib import contextmanager, nullcontext
import io
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time

from graph import POSE_SECONDS, POSES
import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.nodes.fly import run_fly

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / 'test' / 'view'))
from view_browser import opened, until  # noqa: E402

KINDS = ('without viewer', 'viewer', 'viewer and browser')
ROWS = {'latency_median_ms': 'latency, median [ms]', 'latency_p99_ms': '99 %',
        'latency_max_ms': 'max', 'cpu_percent': 'CPU of all nodes [%]'}
SETTLE, WATCH = 4.0, 15.0       # [s] of playback before and while pictures are counted
ADDRESS = re.compile(r'http://localhost:\d+')
PICTURES = '(window.__viserTestpoints?.rendererInfo?.render?.frame ?? 0)'
# Each update places the robot once; the page takes its messages from a queue.
COUNT_MOMENTS = """() => {
    window.moments = window.seen = 0;
    const queue = window.__viserMutable.messageQueue, push = queue.push.bind(queue);
    let arrived = 0, picture = FRAME;
    queue.push = (...messages) => {
        window.moments += messages.filter(
            one => one.type == 'SetPositionMessage' && one.name == '/run0').length;
        return push(...messages);
    };
    const look = () => {
        if (FRAME != picture) {
            picture = FRAME;
            window.seen += window.moments > arrived ? 1 : 0;
            arrived = window.moments;
        }
        requestAnimationFrame(look);
    };
    look();
}""".replace('FRAME', PICTURES)
COUNTS = f'[{PICTURES}, window.moments, window.seen]'


def fly(folder: Path, kind: str, seconds: float) -> dict:
    """Fly once; return what was measured."""
    task, result = folder / 'poses.csv', folder / 'result.json'
    rows = [POSES[k % len(POSES)] for k in range(max(1, round(seconds / POSE_SECONDS)))]
    task.write_text('\n'.join(['x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg', *rows]) + '\n')
    result.unlink(missing_ok=True)
    output = io.StringIO()
    with with_browser(output) if kind == KINDS[2] else nullcontext():
        status = run_fly(task=str(task), actuators='direct', clock='system', json_path=result,
                         view=kind != KINDS[0], console=Console(file=output, width=200))
    if status or not result.exists():
        sys.exit(f'flight {kind} failed (status {status})')
    return json.loads(result.read_text())['meta']['graph']


@contextmanager
def with_browser(output):
    """Open the page of a flight as soon as its address is printed."""
    over = threading.Event()

    def look():
        url = until(lambda: over.is_set() or ADDRESS.search(output.getvalue()), 'an address')
        if url is not True:
            with opened(url.group()):
                over.wait()
    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def play(run: Path, ratio: float) -> dict:
    """Play a bag in a running headless browser; return the measurements."""
    with opened('about:blank', 1280, 720) as (browser, _):
        return watch(run, browser, f'/?fixedDpr={ratio}' if ratio else '')


def watch(run, browser, query):
    """Measure from the start of the command."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'view', str(run)],
        stdout=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    try:
        url = ADDRESS.match(process.stdout.readline())
        if url is None:
            sys.exit(f'{run}: not shown')
        served = time.monotonic() - begin
        mine = set(tree(process.pid))
        spent = sum(map(cpu_seconds, mine))
        before = browser_cpu(mine)
        browser.goto(url.group() + query)
        browser.wait_for_function(f'{PICTURES} > 1', polling=50)
        first, drawing = time.monotonic() - begin, browser_cpu(mine) - before
        browser.wait_for_timeout(1e3 * SETTLE)
        reading = bool(browser.get_by_text('reading').count())
        browser.evaluate(COUNT_MOMENTS)
        at, mine = time.monotonic(), set(tree(process.pid))
        counts = [browser.evaluate(COUNTS)]
        cpu = [(sum(map(cpu_seconds, mine)), browser_cpu(mine))]
        browser.wait_for_timeout(1e3 * WATCH)
        counts.append(browser.evaluate(COUNTS))
        cpu.append((sum(map(cpu_seconds, mine)), browser_cpu(mine)))
        passed = time.monotonic() - at
        pictures, moments, seen = np.diff(counts, axis=0)[0]
        viewer, browsing = np.diff(cpu, axis=0)[0]
        return {'served_s': served, 'served_cpu_s': spent, 'first_picture_s': first,
                'first_picture_browser_cpu_s': drawing, 'still_reading': reading,
                'moments_arrived_per_s': moments / passed, 'moments_seen_per_s': seen / passed,
                'pictures_per_s': pictures / passed,
                'viewer_cpu_percent': 100 * viewer / passed,
                'browser_cpu_ms_per_picture': 1e3 * browsing / max(1, pictures),
                'load': os.getloadavg()[0]}
    finally:
        process.kill()
        process.wait()


def show_flights(flights: dict[str, list[dict]], console: Console) -> None:
    """Print medians, ranges, and whether the viewer's latency is within the noise."""
    table = Table('median (least to most)', *KINDS)
    for key, text in ROWS.items():
        table.add_row(text, *(
            f'{np.median(values):.2f} ({min(values):.2f} to {max(values):.2f})'
            for values in ([flight[key] for flight in flights[kind]] for kind in KINDS)))
    console.print(table)
    without, *others = (np.array([flight['latency_p99_ms'] for flight in flights[kind]])
                        for kind in KINDS)
    for kind, values in zip(KINDS[1:], others, strict=True):
        more, noise = np.median(values) - np.median(without), np.ptp(without)
        console.print(f'99th percentile with {kind}: {more:+.2f} ms; noise {noise:.2f} ms: '
                      f"{'within' if more <= noise else 'ABOVE'}")


def long_bag() -> Path:
    """Bag of 13 minutes; flown if it does not exist."""
    bag = ROOT / 'runs_out' / 'viewer' / 'long'
    if not (bag / 'metadata.yaml').exists():
        bag.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(bag, ignore_errors=True)
        subprocess.run([sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'evaluate',
                        '--controllers', 'rl', '--task', 'random100', '--bag', str(bag)],
                       env={**os.environ, 'PYTHONPATH': str(ROOT)}, check=True)
    return bag


def tree(pid: int) -> list[int]:
    """Processes of a tree."""
    found = [pid]
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            parent = int((entry / 'stat').read_text().rsplit(')', 1)[1].split()[1])
        except OSError:
            continue
        if parent == pid:
            found += tree(int(entry.name))
    return found


def browser_cpu(viewer: set[int]) -> float:
    """CPU time of all started processes, without this one and the viewer [s]."""
    return sum(cpu_seconds(pid) for pid in tree(os.getpid())
               if pid != os.getpid() and pid not in viewer)


def cpu_seconds(pid: int) -> float:
    """User and system time of a process [s]; 0 of one that has ended."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def main():
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    arguments.add_argument('run', type=Path, nargs='?', help='long bag to play')
    arguments.add_argument('--seconds', type=float, default=24, help='flight time of each')
    arguments.add_argument('--rounds', type=int, default=6, help='flights of each kind; 0: none')
    arguments.add_argument('--ratio', type=float, help="pixels drawn for each of the window's; "
                           'default: as the page chooses')
    arguments.add_argument('--no-playback', action='store_true', help='leave the bag out')
    arguments.add_argument('--json', type=Path, help='file for the numbers')
    given = arguments.parse_args()
    console, measured = Console(), {}
    if given.rounds:
        flights = {kind: [] for kind in KINDS}
        with tempfile.TemporaryDirectory() as folder:
            for turn in range(given.rounds):
                for k in range(len(KINDS)):
                    kind = KINDS[(k + turn) % len(KINDS)]
                    flights[kind].append(fly(Path(folder), kind, given.seconds))
        show_flights(flights, console)
        measured['flights'] = flights
    if not given.no_playback:
        measured['playback'] = play(given.run or long_bag(), given.ratio)
        console.print(*(f'{key}: {value:.3g}' for key, value in measured['playback'].items()),
                      sep='\n')
    if given.json:
        given.json.write_text(json.dumps(measured, indent=1) + '\n')


if __name__ == '__main__':
    main()
