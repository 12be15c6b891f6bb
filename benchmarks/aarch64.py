"""
Wheels, tests and instruction counts of the flight path on aarch64, on another computer.

    python benchmarks/aarch64.py wheels            # what PyPI holds for aarch64
    python benchmarks/aarch64.py tests [TEST...]   # the flight path's tests under qemu-user
    python benchmarks/aarch64.py count             # instructions of one NMPC cycle, one inference
    python benchmarks/aarch64.py all [--json FILE]

`tests` and `count` need qemu-user 7 or 8 and a cross compiler: `apt-get install qemu-user
gcc-aarch64-linux-gnu`. They unpack Python and its libraries from Debian's arm64 pool and the
wheels from PyPI into a folder of the cache (--sysroot), 1 GB, once. Nothing there is installed on
this computer. The controller is compiled by the cross compiler, which the emulated Python calls.
"""

from __future__ import annotations

import argparse
from datetime import date
import json
import lzma
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request
import xml.etree.ElementTree as ElementTree

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.robot.native import cache_folder

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ('3.10', '3.11', '3.12', '3.13')      # those of setup.py; Ubuntu 24.04 has 3.12
# Newest first: the C libraries of Debian 12 and Ubuntu 24.04 read all of them.
PLATFORMS = ('manylinux_2_34_aarch64', 'manylinux_2_31_aarch64', 'manylinux_2_28_aarch64',
             'manylinux_2_27_aarch64', 'manylinux_2_26_aarch64', 'manylinux_2_24_aarch64',
             'manylinux_2_17_aarch64', 'manylinux2014_aarch64')
DEBIAN = 'http://deb.debian.org/debian'
RELEASE, PYTHON = 'bookworm', '3.11'            # Debian's release and its Python, for qemu
DEBS = ('python3.11', 'libpython3.11-stdlib', 'libstdc++6', 'libgomp1', 'libgl1', 'libegl1')
# onnxruntime 1.32 ends at its import in qemu 7.2.
EMULATED = ('onnxruntime<1.24', 'pytest>=8', 'pytest-timeout>=2.2', 'hypothesis>=6.100',
            'onnx>=1.16')
# Tests between sensors and actuators, without ROS and without real-time limits: an emulated
# processor does not answer on a servo bus within 3 ms.
TESTS = ('test/estimation/test_noise.py', 'test/estimation/test_odometry.py',
         'test/estimation/test_propagation.py', 'test/estimation/test_guard.py',
         'test/control/test_rti.py', 'test/control/test_ocp.py', 'test/control/test_references.py',
         'test/control/test_observation.py', 'test/control/test_policy_file.py',
         'test/safety/test_limits.py', 'test/safety/test_watch.py', 'test/safety/test_ramp.py',
         'test/drivers/test_mavlink.py', 'test/drivers/test_motor_board_state.py')
ENDINGS = 'failure', 'error', 'skipped'        # of a test case in pytest's report
COMPILER = 'aarch64-linux-gnu-gcc'
PARTS = {2: ('one NMPC cycle', 5.0), 4: ('one step of the policy, with guidance', None),
         6: ('one inference', 0.3)}             # mark -> what it is, bound of p99 [ms]
FIRST = 5       # steps that warm up: what they load and allocate no later one does
CLOCK, CYCLES = 2.2e9, (0.7, 1.0, 1.4)          # [Hz] of a Cortex-A73; instructions a cycle


def requirements() -> dict[str, list[str]]:
    """Extra ('' for none) -> requirements of setup.py that a flight needs."""
    text = (ROOT / 'setup.py').read_text()
    found = {}
    for extra, name in (('', 'REQUIREMENTS'), ('hardware', 'HARDWARE')):
        block = re.search(rf'^{name} = \[(.*?)^\]', text, re.M | re.S).group(1)
        found[extra] = re.findall(r"^    '([^']+)',", block, re.M)
    return found


def resolved(python: str, wanted: list[str]) -> tuple[list[dict], str]:
    """
    Resolve ``wanted`` for aarch64 from wheels only.

    Returns:
        the distributions, each name, version and file; the error message of pip, or ''.

    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / 'report.json'
        done = subprocess.run(
            [sys.executable, '-m', 'pip', 'install', '--dry-run', '--quiet', '--ignore-installed',
             '--only-binary', ':all:', '--target', folder, '--report', str(report),
             '--implementation', 'cp', '--python-version', python,
             *(part for name in PLATFORMS for part in ('--platform', name)), *wanted],
            capture_output=True, text=True, timeout=900)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.startswith('ERROR')]
            return [], lines[-1] if lines else done.stderr.strip()[-200:]
        return [{'name': one['metadata']['name'], 'version': one['metadata']['version'],
                 'file': one['download_info']['url'].rpartition('/')[2]}
                for one in json.loads(report.read_text())['install']], ''


def wheels(console: Console) -> dict:
    """Find the wheels for aarch64 of each distribution of the flight path."""
    wanted = [one for group in requirements().values() for one in group]
    files: dict[str, dict] = {}
    complaints = {}
    for python in PYTHONS:
        found, complaint = resolved(python, wanted)
        if complaint:
            complaints[python] = complaint
        for one in found:
            files.setdefault(one['name'].lower().replace('_', '-'), {})[python] = one
    direct = {re.split(r'[\[<>=;!~ ]', one)[0].lower() for one in wanted}
    table = Table(title=f'wheels for aarch64 on PyPI, {date.today()}')
    for column in ('distribution', *PYTHONS, 'kind'):
        table.add_column(column)
    rows = []
    for name in sorted(files, key=lambda name: (name not in direct, name)):
        versions = files[name]
        kinds = {'any' if one['file'].endswith('any.whl') else 'aarch64'
                 for one in versions.values()}
        rows.append([name if name in direct else f'({name})',
                     *(versions[p]['version'] if p in versions else '-' for p in PYTHONS),
                     ', '.join(sorted(kinds))])
        table.add_row(*rows[-1])
    console.print(table)
    for python, complaint in complaints.items():
        console.print(f'Python {python}: {complaint}', style='red', markup=False)
    return {'rows': rows, 'complaints': complaints,
            'missing': sorted(direct - set(files))}


# --- the sysroot ----------------------------------------------------------------------------

def packages() -> dict[str, dict]:
    """Name -> fields of every package of the release for arm64."""
    url = f'{DEBIAN}/dists/{RELEASE}/main/binary-arm64/Packages.xz'
    with urllib.request.urlopen(url, timeout=120) as answer:
        text = lzma.decompress(answer.read()).decode()
    found = {}
    for block in text.split('\n\n'):
        fields = dict(re.findall(r'^([A-Za-z-]+): (.*)$', block, re.M))
        if 'Package' in fields:
            found[fields['Package']] = fields
    return found


def closure(known: dict[str, dict], wanted) -> list[str]:
    """Packages with all their dependencies; the first of alternatives."""
    done, todo = [], list(wanted)
    while todo:
        name = todo.pop()
        if name in done or name not in known:
            continue
        done.append(name)
        for field in ('Depends', 'Pre-Depends'):
            for part in known[name].get(field, '').split(','):
                todo.append(re.split(r'[ (|:]', part.strip())[0])
    return sorted(done)


def make_sysroot(folder: Path, console: Console) -> Path:
    """Unpack Debian's Python and PyPI's wheels for aarch64 into ``folder``, once."""
    stamp = folder / '.complete'
    wanted = [one for group in requirements().values() for one in group]
    content = json.dumps([RELEASE, DEBS, wanted, EMULATED])
    if stamp.is_file() and stamp.read_text() == content:
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    known = packages()
    names = closure(known, DEBS)
    console.print(f'{len(names)} packages of Debian {RELEASE} arm64')
    for name in names:
        deb = folder / 'package.deb'
        urllib.request.urlretrieve(f"{DEBIAN}/{known[name]['Filename']}", deb)
        subprocess.run(['dpkg-deb', '-x', str(deb), str(folder)], check=True)
        deb.unlink()
    console.print('wheels for aarch64')
    subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--quiet', '--only-binary', ':all:', '--target',
         str(folder / 'site'), '--implementation', 'cp', '--python-version', PYTHON,
         *(part for name in PLATFORMS for part in ('--platform', name)), *wanted, *EMULATED],
        check=True)
    # A process that starts Python again finds it through qemu.
    python = folder / 'usr' / 'bin' / f'python{PYTHON}'
    python.rename(f'{python}.aarch64')
    python.write_text(f'#!/bin/sh\nexec qemu-aarch64 -L {folder} ${{PLUGIN:+-plugin $PLUGIN}} '
                      f'-0 "$0" {python}.aarch64 "$@"\n')
    python.chmod(0o755)
    stamp.write_text(content)
    return folder


def emulated(sysroot: Path, *arguments: str, plugin: str = '', **options):
    """Run Python for aarch64; arguments and options as for subprocess.run."""
    for program in ('qemu-aarch64', COMPILER):
        if not shutil.which(program):
            sys.exit(f'aarch64: {program} is missing: apt-get install qemu-user '
                     'gcc-aarch64-linux-gnu')
    environment = {key: value for key, value in os.environ.items() if key not in (
        'LD_LIBRARY_PATH', 'VIRTUAL_ENV', 'PYTHONHOME', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')}
    environment.update(
        PYTHONPATH=f"{ROOT}:{sysroot / 'site'}", CC=COMPILER, PYTHONDONTWRITEBYTECODE='1',
        XDG_CACHE_HOME=str(sysroot / 'cache'), OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1',
        PLUGIN=plugin)
    return subprocess.run([str(sysroot / 'usr' / 'bin' / f'python{PYTHON}'), *arguments],
                          env=environment, cwd=ROOT, text=True, **options)


def run_tests(sysroot: Path, tests, console: Console) -> list[dict]:
    """Run test files in one process; return outcome and duration of each test."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / 'report.xml'
        done = emulated(sysroot, '-m', 'pytest', '-v', '-p', 'no:cacheprovider', '--timeout',
                        '3000', '-o', 'junit_family=xunit1', f'--junitxml={report}', *tests)
        if not report.is_file():
            sys.exit(f'aarch64: pytest ended with {done.returncode}')
        cases = list(ElementTree.parse(report).getroot().iter('testcase'))
    table, rows = Table(title=f'tests on aarch64 under qemu-user, {date.today()}'), []
    for column in ('tests', 'passed', 'failed', 'skipped', 's'):
        table.add_column(column, justify='left' if column == 'tests' else 'right')
    for test in tests:
        mine = [case for case in cases if case.get('file') == test]
        ended = [next((part.tag for part in case if part.tag in ENDINGS), 'passed')
                 for case in mine]
        failed = sum(ended.count(one) for one in ('failure', 'error')) + (not mine)
        rows.append({'tests': test, 'passed': ended.count('passed'), 'failed': failed,
                     'skipped': ended.count('skipped'),
                     's': round(sum(float(case.get('time')) for case in mine))})
        table.add_row(*map(str, rows[-1].values()))
    console.print(table)
    return rows


def count(sysroot: Path, console: Console) -> list[dict]:
    """Count instructions of controller steps in a recorded flight; bound their duration."""
    here = ROOT / 'benchmarks' / 'instructions'
    with tempfile.TemporaryDirectory() as folder:
        plugin, inputs = f'{folder}/plugin.so', f'{folder}/inputs'
        subprocess.run(['gcc', '-O2', '-shared', '-fPIC', str(here / 'plugin.c'), '-o', plugin],
                       check=True)
        subprocess.run([sys.executable, str(here / 'replay.py'), 'record', inputs], check=True)
        # Once without counting, so that the compiled code exists.
        emulated(sysroot, str(here / 'replay.py'), 'replay', inputs, '--steps', '2', check=True)
        done = emulated(sysroot, str(here / 'replay.py'), 'replay', inputs, plugin=plugin,
                        capture_output=True)
    if done.returncode:
        sys.exit(f'aarch64: counting failed: {done.stderr[-500:]}')
    begin, counts = {}, {key: [] for key in PARTS}
    for number, total in re.findall(r'^mark (\d+) (\d+)$', done.stderr, re.M):
        number, total = int(number), int(total)
        if number in PARTS:
            begin[number] = total
        else:
            counts[number - 1].append(total - begin[number - 1])
    table, rows = Table(title=f'instructions on aarch64, {date.today()}'), []
    for column in ('', 'steps', 'median [10^6]', 'p99', 'max', *(
            f'p99 [ms] at {one} a cycle' for one in CYCLES), 'bound [ms]', 'needs a cycle'):
        table.add_column(column, justify='right')
    for key, (what, bound) in PARTS.items():
        values = np.array(counts[key][FIRST:])
        median, high, most = np.percentile(values, [50, 99, 100])
        rows.append({'what': what, 'steps': len(values), 'median': median, 'p99': high,
                     'max': most, 'bound_ms': bound})
        table.add_row(what, str(len(values)), *(f'{x / 1e6:.2f}' for x in (median, high, most)),
                      *(f'{1e3 * high / one / CLOCK:.2f}' for one in CYCLES),
                      f'{bound or ""}', f'{1e3 * high / bound / CLOCK:.2f}' if bound else '')
    console.print(table)
    return rows


def main():
    """Run the requested parts; status 1 if a wheel is missing or a test fails."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('what', choices=['wheels', 'tests', 'count', 'all'])
    parser.add_argument('tests', nargs='*', default=TESTS)
    parser.add_argument('--sysroot', type=Path, default=cache_folder() / 'aarch64')
    parser.add_argument('--json', type=Path, help='file for the numbers')
    given = parser.parse_args()
    console, found = Console(width=120), {}
    if given.what in ('wheels', 'all'):
        found['wheels'] = wheels(console)
    if given.what != 'wheels':
        make_sysroot(given.sysroot.absolute(), console)
    if given.what in ('tests', 'all'):
        found['tests'] = run_tests(given.sysroot.absolute(), given.tests, console)
    if given.what in ('count', 'all'):
        found['count'] = count(given.sysroot.absolute(), console)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    bad = found.get('wheels', {}).get('missing') or found.get('wheels', {}).get('complaints')
    sys.exit(1 if bad or any(row['failed'] for row in found.get('tests', ())) else 0)


if __name__ == '__main__':
    main()
