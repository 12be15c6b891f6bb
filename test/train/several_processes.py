"""One of several processes that train together; torchrun starts it for test_several."""

import json
import os
from pathlib import Path
import sys

from learning import ROBOT, small

from beetle_omni_ros.train.runner import Runner


def checksum(tensors):
    """Equal for equal tensors, to the last bit."""
    return [value.detach().double().sum().item() for value in tensors]


def main(folder):
    """Train, tell what came out."""
    rank = int(os.environ['RANK'])
    made = Runner(small({'iterations': 1000}), ROBOT, folder / 'run')
    begin = checksum((*made.alg.actor.parameters(), *made.alg.critic.parameters()))
    rows = []
    # Only the first process has had enough after its first iteration.
    made.train(rows.append, stop_after=0.0 if rank == 0 else 1e9)
    result = {'begin': begin, 'distributed': made.is_distributed,
              'weights': checksum((*made.alg.actor.parameters(), *made.alg.critic.parameters())),
              'rate': float(made.alg.rate), 'robots': checksum([made.env.state['x']]),
              'iterations': made.current_learning_iteration, 'folder': str(made.folder),
              'samples_per_second': rows[0]['samples_per_second'], 'seconds': rows[0]['seconds']}
    made.close()
    (folder / f'rank{rank}.json').write_text(json.dumps(result))


if __name__ == '__main__':
    main(Path(sys.argv[1]))
