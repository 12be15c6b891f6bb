"""One of several processes that train together; torchrun starts it for test_several."""

import json
import os
from pathlib import Path
import sys

import learning  # noqa: F401
import torch

from beetle_omni_ros import cli
from beetle_omni_ros.train import command

RANK = int(os.environ['RANK'])


class Runner(command.Runner):
    """Runner on the CPU that is kept for inspection."""

    def _configure_multi_gpu(self):
        """As rsl-rl, which refuses CPUs."""
        self.gpu_world_size, self.is_distributed = 2, True
        self.gpu_global_rank = self.gpu_local_rank = RANK
        self.cfg['multi_gpu'] = {'global_rank': RANK, 'local_rank': RANK, 'world_size': 2}
        torch.distributed.init_process_group('gloo', rank=RANK, world_size=2)

    def train(self, *arguments):
        """Train, and store weights before and after."""
        Runner.made, self.begin = self, self.sums()
        super().train(*arguments)

    def sums(self):
        """Numbers that are equal for bitwise equal networks."""
        return [value.detach().double().sum().item() for value in (
            *self.alg.actor.parameters(), *self.alg.critic.parameters())]


command.Runner, folder = Runner, Path(sys.argv[1])
# Only the first process stops after its first iteration.
status = cli.main(['train', '--smoke', '--device', 'cpu', '--output', str(folder / 'run'),
                   '--set', 'iterations=1000', '--stop-after', '1e9' if RANK else '0'])
made = Runner.made
(folder / f'rank{RANK}.json').write_text(json.dumps({
    'status': status, 'begin': made.begin, 'weights': made.sums(), 'rate': float(made.alg.rate),
    'folder': str(made.folder), 'robots': made.env.state['x'].double().sum().item(),
    'iterations': made.current_learning_iteration}))
