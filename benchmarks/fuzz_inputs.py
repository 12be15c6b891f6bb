"""
Refusal of damaged input files: ``python benchmarks/fuzz_inputs.py --count 2000``.

Parameter files, CSV tasks, MCAP bags and ONNX policies are mutated and read. A refusal must be an
error class of the package with one bounded line, within a time limit. Every other outcome is
printed, and its file is kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
import io
from pathlib import Path
import shutil
import signal
import sys
import tempfile
import time
import traceback

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [place for place in (str(HERE), str(HERE.parent)) if place not in sys.path]

import fuzz_bags  # noqa: E402

from beetle_omni_ros.bringup.limits import CheckLimits  # noqa: E402
from beetle_omni_ros.control.hover import HoverParameters  # noqa: E402
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters  # noqa: E402
from beetle_omni_ros.control.policy import PolicyParameters  # noqa: E402
from beetle_omni_ros.control.policy_network import PolicyNetwork  # noqa: E402
from beetle_omni_ros.drivers.device_parameters import (  # noqa: E402
    MotorBoardParameters,
    ServoBusParameters,
)
from beetle_omni_ros.estimation.parameters import EkfParameters  # noqa: E402
from beetle_omni_ros.identify.gap.parameters import GapParameters  # noqa: E402
from beetle_omni_ros.identify.parameters import IdentifyParameters  # noqa: E402
from beetle_omni_ros.identify.recording.limits import RecordingLimits  # noqa: E402
from beetle_omni_ros.robot.holding import HoldingParameters  # noqa: E402
from beetle_omni_ros.robot.parameters import RobotParameters  # noqa: E402
from beetle_omni_ros.robot.resources import share_path  # noqa: E402
from beetle_omni_ros.robot.schema import ParameterError  # noqa: E402
from beetle_omni_ros.runs.bag import BagError  # noqa: E402
from beetle_omni_ros.runs.pose_file import COLUMNS  # noqa: E402
from beetle_omni_ros.runs.target_checks import TargetLimits  # noqa: E402
from beetle_omni_ros.runs.tasks import make_task, WAYPOINTS  # noqa: E402
from beetle_omni_ros.safety.parameters import SupervisorParameters  # noqa: E402
from beetle_omni_ros.sim.emulated.board_parameters import EmulatedBoardParameters  # noqa: E402
from beetle_omni_ros.sim.faults.listed import FaultList, load_faults  # noqa: E402
from beetle_omni_ros.sim.parameters import SimulatorParameters  # noqa: E402
from beetle_omni_ros.train.parameters import TrainParameters  # noqa: E402

OWN = (ParameterError, BagError)
LONGEST_TEXT = 2000     # characters of a refusal
LONGEST_TIME = 20       # s for one file
PARAMETER_FILES = {
    'check.yaml': CheckLimits, 'degraded.yaml': HoldingParameters, 'ekf.yaml': EkfParameters,
    'faults.yaml': FaultList, 'gap.yaml': GapParameters,
    'emulated_board.yaml': EmulatedBoardParameters, 'hover.yaml': HoverParameters,
    'identify.yaml': IdentifyParameters,
    'motor_board.yaml': MotorBoardParameters, 'nmpc.yaml': NmpcParameters,
    'nmpc_published.yaml': NmpcParameters,
    'recording.yaml': RecordingLimits, 'rl.yaml': PolicyParameters, 'robot.yaml': RobotParameters,
    'robot_weak_and_heavy.yaml': RobotParameters, 'servo_bus.yaml': ServoBusParameters,
    'simulator.yaml': SimulatorParameters, 'supervisor.yaml': SupervisorParameters,
    'targets.yaml': TargetLimits, 'train.yaml': TrainParameters}
LAUGHS = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{two}: &{two} [{", ".join(["*" + one] * 9)}]\n' for one, two in zip('abcdefgh', 'bcdefghi'))
# Values that have broken a reader somewhere.
VALUES = ('.nan', '.inf', '-.inf', '3', '-1', '0', '1e400', '9' * 5000, '0x' + 'f' * 9000, '0b_',
          '[]', '{}', '[[]]', '[1, [2]]', '{a: 1}', '""', 'x', "'" + 'x' * 9000 + "'", 'null',
          'true', '2001-13-99', '2001-01-01', '!!bool x', '!!timestamp x', '!!int ""', '~',
          '!!python/object:os.system {}', '!!binary x', '*nowhere', '&a [*a]', '[' * 60 + ']' * 60,
          '[' * 5000, '1:90', '<<', '? {a: b}', '"\\0"', '[.nan, 1]', '[x, 1, 2]', '!!set {a, b}')


class Hang(Exception):
    """A file took longer than ``LONGEST_TIME``."""


@dataclass(frozen=True)
class Kind:
    """
    One kind of input file.

    Attributes:
        suffix: suffix of the file name.
        sources: folder -> name -> bytes of sound files.
        mutate: (generator, bytes) -> bytes.
        read: (path, name of the source): reads the file like the package.

    """

    suffix: str
    sources: Callable[[Path], dict[str, bytes]]
    mutate: Callable[[np.random.Generator, bytes], bytes]
    read: Callable[[Path, str], object]


def mutate_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """Flip, cut out, repeat or append some bytes."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at, length = int(rng.integers(len(data) + 1)), int(rng.integers(1, 40))
        match rng.integers(5):
            case 0 if at < len(data):
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                del data[at:at + length]
            case 2:
                data[at:at] = data[at:at + length]
            case 3:
                data[at:at + length] = rng.bytes(length)
            case 4 if rng.random() < 0.2:
                del data[at:]
    return bytes(data)


def mutate_yaml(rng: np.random.Generator, data: bytes) -> bytes:
    """Replace a value or key by a hostile one, shuffle lines, or mutate bytes."""
    lines = data.decode().splitlines()
    at = int(rng.integers(len(lines)))
    value = VALUES[rng.integers(len(VALUES))]
    key, colon, _ = lines[at].partition(':')
    match rng.integers(7):
        case 0 | 1 | 2:
            lines[at] = f'{key}: {value}' if colon and '#' not in key else value
        case 3:
            lines[at] = f'{value}{colon}{lines[at][len(key) + 1:]}'
        case 4:
            lines[at:at] = LAUGHS.splitlines() + [f'{key}: *i']
        case 5:
            lines[at] = ('  ' * int(rng.integers(4))) + lines[rng.integers(len(lines))].lstrip()
        case 6:
            return mutate_bytes(rng, data)
    return '\n'.join([*lines, '']).encode()


def mutate_csv(rng: np.random.Generator, data: bytes) -> bytes:
    """Replace a cell by a hostile one, or mutate bytes."""
    if rng.random() < 0.4:
        return mutate_bytes(rng, data)
    rows = [line.split(',') for line in data.decode().splitlines()]
    row = rows[rng.integers(len(rows))]
    cells = ('nan', 'inf', '-5', '1e308', '1e400', '', '"', 'x' * 200_000, '9' * 5000, '\0', '١')
    row[rng.integers(len(row))] = cells[rng.integers(len(cells))]
    return '\n'.join(','.join(row) for row in rows).encode()


def mutate_onnx(rng: np.random.Generator, data: bytes) -> bytes:
    """Corrupt one entry of the metadata, or mutate bytes anywhere."""
    keys = [key for key in (b'observations', b'action_scale', b'robot_hash', b'rate_hz',
                            b'training', b'format') if key in data]
    if not keys or rng.random() < 0.5:
        return mutate_bytes(rng, data)
    at = data.rindex(keys[rng.integers(len(keys))]) + int(rng.integers(40))
    return data[:at] + rng.bytes(int(rng.integers(1, 4))) + data[at + 1:]


def parameter_files(_folder: Path) -> dict[str, bytes]:
    """All shipped parameter files."""
    return {name: share_path(f'params/{name}').read_bytes() for name in PARAMETER_FILES}


def flight_faults(_folder: Path) -> dict[str, bytes]:
    """A file for ``evaluate --faults``."""
    return {'faults': b'faults:\n  - {what: rotor_stops, at: 3.0, duration: 2.0, rotor: 2}\n'
                      b'  - what: mocap_jumps\n    at: 10\n    x: 1.5\n'
                      b'  - {what: mocap_lost_for_1_s, at: 10}\n'}


def tasks(_folder: Path) -> dict[str, bytes]:
    """A CSV task of the real-world poses."""
    text = io.StringIO()
    np.savetxt(text, WAYPOINTS, delimiter=',', header=','.join(COLUMNS), comments='')
    return {'waypoints': text.getvalue().encode()}


def policies(_folder: Path) -> dict[str, bytes]:
    """The shipped policies."""
    return {name: share_path(f'policies/{name}').read_bytes()
            for name in ('rl.onnx', 'rl_memory.onnx')}


KINDS = {
    'yaml': Kind('.yaml', parameter_files, mutate_yaml,
                 lambda path, name: PARAMETER_FILES[name].load(path)),
    'faults': Kind('.yaml', flight_faults, mutate_yaml, lambda path, _: load_faults(path)),
    'csv': Kind('.csv', tasks, mutate_csv, lambda path, _: make_task(str(path))),
    'mcap': Kind('.mcap', fuzz_bags.bags, mutate_bytes, fuzz_bags.read_flight),
    'messages': Kind('.mcap', fuzz_bags.bags, fuzz_bags.mutate_messages, fuzz_bags.read_flight),
    'metadata': Kind('.yaml', fuzz_bags.metadata, mutate_yaml, fuzz_bags.read_metadata),
    'onnx': Kind('.onnx', policies, mutate_onnx,
                 lambda path, _: PolicyNetwork(path, RobotParameters.load()))}


def fuzz(kind: Kind, count: int, seed: int, folder: Path) -> tuple[int, list[str]]:
    """
    Read ``count`` mutated files.

    Returns:
        number of correct refusals, and a text for each other outcome.

    """
    sources = kind.sources(folder)
    refused, findings = 0, []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        name = sorted(sources)[rng.integers(len(sources))]
        path = folder / f'{Path(name).stem}_{seed}_{k}{kind.suffix}'
        path.write_bytes(kind.mutate(rng, sources[name]))
        problem = ask(kind, path, name)
        refused += problem == ''
        if problem:
            findings.append(f'{path}: {problem}')
        else:
            path.unlink()
    return refused, findings


def ask(kind: Kind, path: Path, name: str) -> str | None:
    """None: accepted; '': refused in one line; else a description of the defect."""
    try:
        with limited():
            kind.read(path, name)
    except OWN as error:
        text = str(error)
        if '\n' in text or len(text) > LONGEST_TEXT:
            return f'a refusal of {len(text)} characters, {text.count(chr(10)) + 1} lines'
        return ''
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return f'{type(error).__name__} in {Path(place.filename).name}:{place.lineno}: ' \
               f'{str(error)[:200]}'
    return None


@contextmanager
def limited():
    """
    Limit a context to ``LONGEST_TIME``; needs Unix and the main thread.

    Raises:
        Hang: it took longer.

    """
    def late(*_):
        raise Hang(f'more than {LONGEST_TIME} s')

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST_TIME)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def main(arguments: list[str] | None = None) -> int:
    """Fuzz all or the given kinds; status 1 after a finding."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split('\n\n')[0])
    parser.add_argument('--count', type=int, default=2000, help='files of each kind')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--kinds', default=','.join(KINDS), help='separated by commas')
    given = parser.parse_args(arguments)
    failed = False
    for name in given.kinds.split(','):
        folder = Path(tempfile.mkdtemp(prefix=f'fuzz_{name}_'))
        begin = time.perf_counter()
        refused, findings = fuzz(KINDS[name], given.count, given.seed, folder)
        print(f'{name}: {given.count} files, {refused} refused, {len(findings)} findings, '
              f'{time.perf_counter() - begin:.0f} s', flush=True)
        for text in findings:
            print(f'  {text}')
        if not findings:
            shutil.rmtree(folder, ignore_errors=True)
        failed |= bool(findings)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
