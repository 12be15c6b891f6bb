"""One of several processes that train together; torchrun starts it for test_several."""

import json
import os
from pathlib import Path
import sys

import learning  # noqa: F401

from beetle_omni_ros import cli
from beetle_omni_ros.train import command


def checksum(tensors):
    """Number that is equal for bitwise equal tensors."""
    return [value.detach().double().sum().item() for value in tensors]


def networks(made):
    """Every parameter."""
    return checksum((*made.alg.actor.parameters(), *made.alg.critic.parameters()))


class Runner(command.Runner):
    """Runner of the training that is kept for inspection."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        Runner.made, self.begin, self.rows = self, networks(self), []

    def train(self, progress, stop_after):
        """Train, and store the progress rows."""
        def both(row):
            self.rows.append(row)
            progress(row)
        super().train(both, stop_after)


def main(folder):
    """Train by the command and print the result."""
    rank = os.environ['RANK']
    command.Runner = Runner
    # Only the first process stops after its first iteration.
    status = cli.main(['train', '--smoke', '--device', 'cpu', '--output', str(folder / 'run'),
                       '--set', 'iterations=1000', '--stop-after', '0' if rank == '0' else '1e9'])
    made = Runner.made
    result = {
        'status': status, 'begin': made.begin, 'distributed': made.is_distributed,
        'weights': networks(made), 'rate': float(made.alg.rate), 'folder': str(made.folder),
        'robots': checksum([made.env.state['x']]), 'iterations': made.current_learning_iteration,
        'samples': made.rows[0]['samples_per_second'] * made.rows[0]['seconds']}
    (folder / f'rank{rank}.json').write_text(json.dumps(result))


if __name__ == '__main__':
    main(Path(sys.argv[1]))
