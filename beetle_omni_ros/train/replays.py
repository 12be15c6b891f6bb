"""
Situations that were missed are flown again.

Of a trained policy's targets one in a thousand is missed, and so rarely met that nothing more is
learnt from it. So every robot keeps the whole state in which its present target began; where it
misses, the state is stored, and some of the next episodes begin with a stored one, until it is
flown well: prioritised sampling of starts, as in T. Schaul et al., Prioritized experience replay
(2016), but of situations and not of steps.
"""

from __future__ import annotations

import torch

from beetle_omni_ros.train import batch

MISSED_POSITION, MISSED_ATTITUDE = 0.10, 0.10     # [m], [rad] at the end of a target's time
MISSED_DEPTH = 0.3                                # [m] below both start and target, on the way
FULL = 0.01          # stored situations, as a share of the robots, from which all replays happen
FORGET_FLOWN, FORGET_MISSED = 0.5, 0.1            # chance that a replay's situation is dropped


class Replays:
    """
    A store with one place for each robot; all of it is in the environment's state.

    Args:
        example: state of N robots, (N, ...) floating point tensors by name.
        share: of the new episodes that begin with a stored situation, at most.
        steps: for which such a target stands.

    """

    def __init__(self, example: dict[str, torch.Tensor], share: float, steps: float):
        self._parts = {name: value.shape[1:] for name, value in example.items()}
        self._share, self._steps = share, steps

    def state(self, example: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Entries of an empty store: 'begun', 'stored' (N, K), 'filled', 'source' (N,)."""
        begun = self._packed(example)
        return {'begun': begun, 'stored': begun.clone(), 'filled': torch.zeros_like(begun[:, 0]),
                'source': torch.full_like(begun[:, 0], -1.0)}

    def _packed(self, state):
        return torch.cat([state[name].flatten(1) if state[name].dim() > 1 else
                          state[name][:, None] for name in self._parts], -1)

    def unpacked(self, packed: torch.Tensor) -> dict[str, torch.Tensor]:
        """States (N, ...) by name, of stored ones (N, K)."""
        sizes = [shape.numel() for shape in self._parts.values()]
        return {name: part.reshape(-1, *shape)
                for (name, shape), part in zip(self._parts.items(), packed.split(sizes, -1))}

    def step(self, s: dict, new: dict, fresh: dict, ends: dict, draw: batch.Draw) -> tuple:
        """
        Store what was missed, forget what was flown, and choose who begins with a stored one.

        Args:
            s: the state before the step, with the entries of :meth:`state`.
            new: the state after it, new targets given, before robots start anew.
            fresh: new robots, as drawn.
            ends: (N,) bool 'due' (the target's time is over), 'done' (the episode is),
                'missed' (a target, or the robot; where this is known).
            draw: random numbers, three a robot.

        Returns:
            the state with robots started anew, complete, and new entries.

        """
        over, replayed = ends['due'] | ends['done'], s['source'] >= 0
        chance, pick, choice = draw.uniform(3).unbind(-1)
        judged = replayed & (ends['due'] | ends['missed'])
        drop = judged & (chance < torch.where(ends['missed'], FORGET_MISSED, FORGET_FLOWN))
        place = s['source'].clamp(min=0).long()
        dropped = torch.zeros_like(s['filled']).scatter_add(0, place, drop.float())
        keep = ends['missed'] & ~replayed
        stored = torch.where(keep[:, None], s['begun'], s['stored'])
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
            begun = torch.where(spread(chosen, again[name]), again[name], fresh[name])
            new[name] = torch.where(spread(ends['done'], begun), begun, new[name])
        source = torch.where(chosen, place.float(), torch.where(over, -1.0, s['source']))
        new.update(stored=stored, filled=filled, source=source,
                   begun=torch.where(over[:, None], self._packed(new), s['begun']))
        return new


def spread(mask: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Mask (N,) shaped to select rows of ``like`` (N, ...)."""
    return mask.view(-1, *[1] * (like.dim() - 1))
