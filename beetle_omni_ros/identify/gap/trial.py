"""What a search tries, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.candidates import Candidate
from beetle_omni_ros.identify.gap.fit import State
from beetle_omni_ros.identify.inference.blocks import HeldOut

TOO_SMALL = 'too small to matter'
IMPOSSIBLE = 'beyond what is physical'
NOT_HELD = 'does not hold on data left out'
FOUGHT = 'in slow or in quick motion alone, as gusts and answers to them'


@dataclass
class Trial:
    """
    One candidate joined to the model.

    Attributes:
        candidate: which.
        gain: of the objective.
        theta: all numbers with it.
        refined: whether fitted, else a straight line's estimate.
        believed: part of the gain that is of beliefs: tolerances which stray less beside it.
        held: gains on blocks left out.
        share: of what was left unexplained.
        reason: why not accepted, '' if it was.

    """

    candidate: Candidate
    gain: float
    theta: dict[str, float]
    refined: bool = False
    believed: float = 0.0
    held: HeldOut = HeldOut(np.zeros(1))
    share: float = 0.0
    reason: str = ''


@dataclass
class Found:
    """
    What a search found.

    Attributes:
        accepted: steps, in the order of acceptance.
        trials: label -> last trial of every candidate.
        rivals: label of an accepted candidate -> trials that explain as much.
        base: numbers of the fit without effects.
        theta: of the final fit.
        state: there, with the slopes of all keys.
        cost: objective of base, final, and everything (straight line).
        still: whether the robot hardly moves but where it is pushed; see ``liveliness``.

    """

    accepted: list[Trial] = field(default_factory=list)
    trials: dict[str, Trial] = field(default_factory=dict)
    rivals: dict[str, list[Trial]] = field(default_factory=dict)
    base: dict[str, float] = field(default_factory=dict)
    theta: dict[str, float] = field(default_factory=dict)
    state: State | None = None
    cost: tuple[float, float, float] = (0.0, 0.0, 0.0)
    still: bool = False

    @property
    def explained(self) -> float:
        """Part of the explainable excess that the accepted entries explain."""
        before, after, floor = self.cost
        return (before - after) / max(before - floor, 1e-9)
