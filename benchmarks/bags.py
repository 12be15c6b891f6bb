"""
Size and CPU time of a recording: with and without frames, with and without compression.

    python benchmarks/bags.py RUN

Writes the messages of a recorded flight in each variant; numbers are relative to the flight time.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import tempfile
import time

from rich.console import Console
from rich.table import Table

from beetle_omni_ros.robot.urdf import description
from beetle_omni_ros.runs.bag import BagWriter, read_messages
from beetle_omni_ros.runs.rosbag2_writer import COMPRESSIONS

OURS = '/tf', '/tf_static', '/robot_description'    # made again, where they are wanted
FLUSH_PERIOD = 0.4      # [s] as recorder_node


def write(messages, folder: Path, **options) -> tuple[float, int]:
    """CPU time [s] and size [B] of the messages in a new bag."""
    begin = time.process_time()
    with BagWriter(folder, topics=(), **options) as bag:
        flushed = messages[0].received
        for message in messages:
            bag.write_raw(message.topic, message.type, message.data, message.received)
            if message.received > flushed + FLUSH_PERIOD:
                flushed = message.received
                bag.flush()
    return time.process_time() - begin, sum(file.stat().st_size for file in folder.iterdir())


def main():
    """Write and print."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('run', type=Path, help='rosbag2 folder')
    given = parser.parse_args()
    messages = [message for message in read_messages(given.run) if message.topic not in OURS]
    length = messages[-1].received - messages[0].received
    table = Table(title=f'{given.run.name}: {len(messages)} messages, {length:.0f} s')
    for column in ('frames', 'compression', 'kB/s', 'CPU [% of one core]'):
        table.add_column(column, justify='right')
    for frames in (False, True):
        for compression in COMPRESSIONS:
            with tempfile.TemporaryDirectory() as folder:
                cpu, size = write(messages, Path(folder) / 'bag', compression=compression,
                                  description=description() if frames else '')
            table.add_row('yes' if frames else 'no', compression, f'{1e-3 * size / length:.0f}',
                          f'{100 * cpu / length:.2f}')
    Console(width=100).print(table)


if __name__ == '__main__':
    main()
