"""What the engine found on several flights."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import comb, log

import numpy as np

from beetle_omni_ros.identify.flights.evidence import Judge, Normal, Posterior
from beetle_omni_ros.identify.flights.priors import Entry
from beetle_omni_ros.identify.flights.spectrum import Spectrum


@dataclass(eq=False)
class Solution:
    """
    Result of the engine.

    Attributes:
        names: keys.
        entries: catalogue entries.
        gains: set of indices of entries -> ln of its evidence over that of the empty set.
        best: most probable set.
        posterior: its evidence and estimate.
        unsteady: named entry -> gain of one value for each group of bands over one value [nat].
        banned: entry that was excluded for this -> its gain.
        by_band: key of an excluded entry and its further value in each band (bands,).

    """

    names: list[str]
    entries: list[Entry]
    gains: dict[tuple[int, ...], float]
    best: tuple[int, ...]
    posterior: Posterior
    equations: Normal
    judge: Judge
    spectra: list[Spectrum] = field(default_factory=list)
    unsteady: dict[int, float] = field(default_factory=dict)
    banned: dict[int, float] = field(default_factory=dict)
    by_band: list[tuple[int, np.ndarray]] = field(default_factory=list)

    @property
    def theta(self) -> np.ndarray:
        """(K,) mean of the keys with the best set."""
        return self.posterior.theta

    @property
    def e_value(self) -> float:
        """Ln of the evidence of sets with an effect over those without, averaged by priors."""
        parts: dict[bool, list[float]] = {True: [-np.inf], False: []}
        for chosen, gain in self.gains.items():
            effect = not all(self.entries[k].varying for k in chosen)
            parts[effect].append(log_prior(len(chosen), len(self.entries)) + gain)
        return float(np.logaddexp.reduce(parts[True]) - np.logaddexp.reduce(parts[False]))


def log_prior(size: int, count: int) -> float:
    """Ln of the prior of one set of ``size`` of ``count`` entries; one more is half as likely."""
    return -(size + 1) * log(2.0) - log(comb(count, size))
