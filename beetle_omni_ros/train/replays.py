"""
Replay of missed targets.

A trained policy misses about one target in a thousand. Such situations are too rare in training to
improve the policy. The environment therefore keeps, for every robot, the state at the start of its
present target. If the target is missed, this state is stored. A fraction of the next episodes
begin with stored states, until these are flown well. This is prioritised sampling of initial
states, similar to that of steps in T. Schaul et al., Prioritized experience replay (2016).
"""

import torch

from beetle_omni_ros.train import batch

MISSED_POSITION, MISSED_ATTITUDE = 0.10, 0.10     # [m], [rad] at the end of a target's time
MISSED_DEPTH = 0.3                                # [m] below both start and target, in between
FULL = 0.01          # fraction of the robots with a stored state at which all replays happen
FORGET_FLOWN, FORGET_MISSED = 0.5, 0.1            # probability of deletion after a replay


class Replays:
    """
    Store with one place for each robot; its content is in the environment's state.

    Args:
        example: state of N robots, (N, ...) floating point tensors by name.
        share: largest fraction of the new episodes that begin with a stored state.
        steps: duration of a replayed target in steps.

    """

    def __init__(self, example: dict[str, torch.Tensor], share: float, steps: float):
        self._parts = {name: value.shape[1:] for name, value in example.items()}
        self._share, self._steps = share, steps

    def state(self, example: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Entries of an empty store: 'target_start', 'stored' (N, K), 'filled', 'source' (N,)."""
        packed = self._packed(example)
        return {'target_start': packed, 'stored': packed.clone(),
                'filled': torch.zeros_like(packed[:, 0]),
                'source': torch.full_like(packed[:, 0], -1.0)}

    def _packed(self, state):
        return torch.cat([state[name].flatten(1) if state[name].dim() > 1 else
                          state[name][:, None] for name in self._parts], -1)

    def unpacked(self, packed: torch.Tensor) -> dict[str, torch.Tensor]:
        """States (N, ...) by name, from stored ones (N, K)."""
        sizes = [shape.numel() for shape in self._parts.values()]
        return {name: part.reshape(-1, *shape)
                for (name, shape), part in zip(self._parts.items(), packed.split(sizes, -1))}

    def step(self, s: dict, new: dict, fresh: dict, ends: dict, draw: batch.Draw) -> tuple:
        """
        Store missed states, delete flown ones, and choose the robots that begin with a stored one.

        Args:
            s: state before the step, with the entries of :meth:`state`.
            new: state after the step, with new targets, before the reset of robots.
            fresh: new robots.
            ends: (N,) bool 'due' (time of the target is over), 'done' (end of the episode),
                'missed' (target or robot lost, if this can be judged).
            draw: source of random numbers, three for each robot.

        Returns:
            complete state with robots reset, and the new entries.

        """
        over, replayed = ends['due'] | ends['done'], s['source'] >= 0
        chance, pick, choice = draw.uniform(3).unbind(-1)
        judged = replayed & (ends['due'] | ends['missed'])
        drop = judged & (chance < torch.where(ends['missed'], FORGET_MISSED, FORGET_FLOWN))
        place = s['source'].clamp(min=0).long()
        dropped = torch.zeros_like(s['filled']).scatter_add(0, place, drop.float())
        keep = ends['missed'] & ~replayed
        stored = torch.where(keep[:, None], s['target_start'], s['stored'])
        filled = torch.where(keep, 1.0, torch.where(dropped > 0, 0.0, s['filled']))
        upto = filled.cumsum(0)
        count = upto[-1]
        share = self._share * (count / (FULL * len(filled))).clamp(max=1.0)
        chosen = ends['done'] & (choice < share)
        place = torch.searchsorted(upto, pick * count, right=True).clamp(max=len(filled) - 1)
        again = self.unpacked(stored[place])
        again['age'] = torch.zeros_like(again['age'])
        again['target_left'] = torch.full_like(again['target_left'], self._steps)
        for name in self._parts:
            start = torch.where(spread(chosen, again[name]), again[name], fresh[name])
            new[name] = torch.where(spread(ends['done'], start), start, new[name])
        source = torch.where(chosen, place.float(), torch.where(over, -1.0, s['source']))
        new.update(stored=stored, filled=filled, source=source, target_start=torch.where(
            over[:, None], self._packed(new), s['target_start']))
        return new


def spread(mask: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Mask (N,) shaped to select rows of ``like`` (N, ...)."""
    return mask.view(-1, *[1] * (like.dim() - 1))
