"""Which cases a campaign holds: drawn from one seed, each complete in itself."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
import hashlib
import json
from pathlib import Path

import numpy as np
import yaml

from gap_data.effects import COMPANIONS, SHAPES

HERE = Path(__file__).parent
# Files that make no flight; of this one, the fields of a case are in its key.
OTHERS = {'__init__.py', 'campaign.py', 'campaign.yaml', 'cases.py', 'judge.py', 'score.py'}
LEAST = {'mass': -0.2, 'rotor_lag': -0.04}      # sizes
KINDS = ('singles', 'none', 'pairs', 'outside', 'undecidable')
DIFFICULTIES = ('clean', 'hard')


@dataclass(frozen=True)
class Case:
    """
    One case, from which its flights follow completely.

    Attributes:
        kind: in ``KINDS``; difficulty: in ``DIFFICULTIES``.
        seed: of everything drawn within it.
        effects: (name, size, shape) of each hidden effect.
        course: of the flights.
        multibody, gust, tolerance: what makes it hard.
        conditions: 'nominal' or 'published' noise and latency.
        noise: factor on the sensors' noise.
        duration: [s] of a flight; fit, holdout: number of flights.

    """

    kind: str
    difficulty: str
    seed: int
    effects: tuple[tuple[str, float, str], ...] = ()
    course: str = 'poses'
    multibody: bool = False
    gust: bool = False
    tolerance: bool = False
    conditions: str = 'nominal'
    noise: float = 1.0
    duration: float = 60.0
    fit: int = 2
    holdout: int = 1

    def key(self) -> str:
        """Name of its folders: 16 hex digits of what it is and of the generator that makes it."""
        text = json.dumps(asdict(self), sort_keys=True) + fingerprint()
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def accept(self) -> tuple[str, ...]:
        """Verdicts that are right without a name."""
        none = ('no_gap', *(('not_decidable',) if self.course == 'hover' else ()))
        return {'none': none, 'outside': ('unknown',),
                'undecidable': ('not_decidable',)}.get(self.kind, ())

    def allowed(self) -> tuple[str, ...]:
        """Names that are not wrong beside the hidden effects."""
        names = [c for name, _, _ in self.effects for c in COMPANIONS.get(name, ())]
        return tuple(names + (['module_reaction'] if self.multibody else []))


@cache
def fingerprint() -> str:
    """Of the generator's files, so that a change of theirs makes every flight anew."""
    files = {*HERE.glob('*.py'), *HERE.glob('*.yaml')}
    return hashlib.sha256(b''.join(path.read_bytes() for path in sorted(files)
                                   if path.name not in OTHERS)).hexdigest()


def load_settings() -> dict:
    """Everything that stands in ``campaign.yaml``."""
    return yaml.safe_load((HERE / 'campaign.yaml').read_text())


def make_cases(which: str, seed: int) -> list[Case]:
    """Draw the cases of a set of ``campaign.yaml``."""
    settings, cases = load_settings(), list[Case]()
    for difficulty, counts in settings['sets'][which].items():
        for kind, count in counts.items():
            rng = np.random.default_rng([seed, DIFFICULTIES.index(difficulty),
                                         KINDS.index(kind)])
            cases += [_case(settings, kind, difficulty, k, rng) for k in range(count)]
    return cases


def _case(settings, kind, difficulty, k, rng) -> Case:
    drawn = DRAW[kind](settings, difficulty, k, rng)
    hard = {'multibody': True, 'gust': True, 'tolerance': True,
            'conditions': ('published', 'nominal')[k % 2]} if difficulty == 'hard' else {}
    return Case(kind, difficulty, **{'seed': int(rng.integers(2 ** 31)), **settings['flights'],
                                     **hard, **drawn})


def _effect(settings, name, difficulty, rng):
    """Name, signed size and shape; the clean half has the textbook's shapes."""
    entry = settings['effects'][name]
    size = float(np.exp(rng.uniform(*np.log(entry['range']))))
    size = max(size * int(rng.choice(entry['signs'])), LEAST.get(name, -np.inf))
    shapes = SHAPES.get(name, ()) if difficulty == 'hard' else ()
    return name, size, str(rng.choice(shapes)) if shapes else 'plain'


def _single(settings, difficulty, k, rng):
    names = list(settings['effects'])
    order = np.random.default_rng(5).permutation(len(names))  # spread over layers in small sets
    name = names[order[k % len(names)]]
    return {'effects': (_effect(settings, name, difficulty, rng),),
            'multibody': name == 'module_reaction' or difficulty == 'hard'}


def _none(settings, difficulty, k, rng):
    harder = {'noise': 2.0 if k % 3 == 2 else 1.0,
              'course': ('poses', 'lemniscate', 'poses', 'hover')[k % 4]}
    if difficulty == 'hard':    # half calm; now and then without one of the other hardships
        harder |= {'gust': k // 4 % 2 == 0, 'conditions': ('published', 'nominal')[k // 8 % 2],
                   'multibody': k % 5 != 4, 'tolerance': k % 7 != 6}
    return harder


def _pair(settings, difficulty, k, rng):
    pair = settings['pairs'][k % len(settings['pairs'])]
    return {'effects': tuple(_effect(settings, name, difficulty, rng) for name in pair)}


def _outside(settings, difficulty, k, rng):
    name = list(settings['outside'])[k % len(settings['outside'])]
    size = float(rng.uniform(*settings['outside'][name]['range']))
    return {'effects': ((name, size, 'plain'),)}


def _undecidable(settings, difficulty, k, rng):
    name = list(settings['undecidable'])[k % len(settings['undecidable'])]
    return {'effects': (_effect(settings, name, 'clean', rng),), 'course': 'hover'}


DRAW: dict[str, Callable[..., dict]] = {
    'singles': _single, 'none': _none, 'pairs': _pair, 'outside': _outside,
    'undecidable': _undecidable}
