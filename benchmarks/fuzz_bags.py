"""Bags for fuzz_inputs.py: broken bytes, hostile messages in a sound file, hostile metadata."""

from __future__ import annotations

from pathlib import Path
import struct
import tempfile

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.robot.readings import BatteryReading, ImuReading, JointReading, PoseReading
from beetle_omni_ros.runs.bag import BagWriter, read_bag, read_messages
from beetle_omni_ros.runs.report import make_page, make_runs, results_of

LEVEL = np.array([0, 0, 0, 1.0])
ZERO = np.zeros(3)
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0)
PAGES = 8       # number of files for each drawn page


def bags(folder: Path) -> dict[str, bytes]:
    """One short bag with every kind of message that a report uses."""
    with BagWriter(folder / 'bag', {'task': 'waypoints', 'seed': 1}) as writer:
        writer.write_target(PoseTarget(position=np.array([0, 0, 1.0]), quaternion=LEVEL,
                                       stamp=1.5))
        for k in range(60):
            t = 1 + 0.05 * k
            for topic, value in (
                    ('ground_truth/odom', Odom(t, ZERO, ZERO, LEVEL, ZERO)),
                    ('odom', Odom(t, ZERO, ZERO, LEVEL, ZERO)),
                    ('imu/data_raw', ImuReading(t, ZERO, ZERO)),
                    ('mocap/pose', PoseReading(t, ZERO, LEVEL)),
                    ('joint_states', JointReading(t, np.zeros(4), np.zeros(4))),
                    ('battery_state', BatteryReading(t, 24.0, -10.0)),
                    ('command', Command(t, np.zeros(4), np.ones(4)))):
                writer.write(topic, value)
            writer.write('supervisor/state', 'flying:nmpc', t)
            writer.write_diagnostic(t, 'nmpc_node', {'rejected': '3'}, 1, 'late')
    return {'bag': next((folder / 'bag').glob('*.mcap')).read_bytes()}


def mutate_messages(rng: np.random.Generator, data: bytes) -> bytes:
    """Write the bag again with hostile numbers, bytes, stamps or lengths in some messages."""
    with tempfile.TemporaryDirectory(prefix='fuzz_') as folder:
        source = Path(folder) / 'source.mcap'
        source.write_bytes(data)
        with BagWriter(Path(folder) / 'bag', {'task': 'hover'}) as writer:
            for message in read_messages(source):
                raw = bytearray(message.data)
                if rng.random() < 0.1:
                    _spoil(rng, raw)
                at = message.received * (1 if rng.random() > 0.01 else rng.integers(1 << 20))
                writer.write_raw(message.topic, message.type, bytes(raw), at)
        return next((Path(folder) / 'bag').glob('*.mcap')).read_bytes()


def _spoil(rng, raw):
    """Change the bytes of one message in place."""
    at = int(rng.integers(4, len(raw)))
    match rng.integers(5):
        case 0:
            raw[at] ^= 1 << int(rng.integers(8))
        case 1:
            del raw[at:]
        case 2:
            raw[at:at] = rng.bytes(int(rng.integers(1, 100)))
        case 3 | 4:
            at -= at % 8 - 4        # CDR numbers are aligned behind a header of four bytes
            raw[at:at + 8] = struct.pack('<d', NUMBERS[rng.integers(len(NUMBERS))])


def read_flight(path: Path, _name: str):
    """Read a bag and compute metrics, for some also the page, like ``beetle_omni report``."""
    with np.errstate(all='ignore'):
        runs = make_runs([read_bag(path)], ['run'])
        results = results_of(runs)
        if int(path.stem.rpartition('_')[2]) % PAGES == 0:
            make_page(runs, results)


def read_metadata(path: Path, _name: str):
    """Read a sound bag with a given metadata.yaml."""
    with tempfile.TemporaryDirectory(prefix='fuzz_') as folder:
        place = Path(folder)
        bags(place)
        (place / 'bag' / 'metadata.yaml').write_bytes(path.read_bytes())
        with np.errstate(all='ignore'):
            results_of(make_runs([read_bag(place / 'bag')], ['run']))


def metadata(folder: Path) -> dict[str, bytes]:
    """The metadata.yaml of one bag."""
    bags(folder)
    return {'metadata': (folder / 'bag' / 'metadata.yaml').read_bytes()}
