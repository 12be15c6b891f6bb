"""Which cases a campaign holds: drawn from one seed, each complete in itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
import hashlib
import json
from pathlib import Path

import numpy as np
import yaml

from gap_data.effects import COMPANIONS, SHAPES

HERE = Path(__file__).parent
GENERATOR = ('bags.py', 'controller.py', 'courses.py', 'effects.py', 'effects_actuators.py',
             'effects_body.py', 'effects_outside.py', 'effects_sensors.py', 'flight.py',
             'gusts.py', 'hidden.py', 'make.py', 'mjcf.py', 'numbers.yaml', 'plant.py',
             'rotors.py', 'sensors.py', 'truth.py')
KINDS = ('singles', 'none', 'pairs', 'outside', 'undecidable', 'short', 'damaged', 'power')
DIFFICULTIES = ('clean', 'hard')
# kind of damage -> the hidden effect, if any, and the verdicts that are right beside its name
DAMAGED = {
    'missing_imu': (None, ('bad_data', 'refused')),
    'missing_mocap': (None, ('bad_data', 'refused')),
    'missing_command': (None, ('bad_data', 'refused')),
    'clock_jump': ('thrust_coefficient', ('bad_data', 'refused')),
    'duplicates': ('thrust_coefficient', ('bad_data', 'refused')),
    'cut': ('thrust_coefficient', ('bad_data', 'not_decidable', 'refused')),
    'gaps': ('rotor_drag', ('bad_data', 'not_decidable', 'refused')),
    'rest': (None, ('bad_data', 'not_decidable', 'refused')),
    'broken_robot': (None, ('refused', 'bad_data')),
}


@dataclass(frozen=True)
class Case:
    """
    One case, from which its flights follow completely.

    Attributes:
        kind: in ``KINDS``; difficulty: in ``DIFFICULTIES``.
        seed: of everything drawn within it.
        effects: (name, size, shape) of each hidden effect.
        course: of the flights; damage: of the bags, or ''.
        multibody, gust, tolerance: what makes it hard.
        conditions: 'nominal' or 'published' noise and latency.
        noise: factor on the sensors' noise.
        command_age: [s] from a command's stamp until it acts.
        duration: [s] of a flight; fit, holdout: number of flights.
        multiple: of the detection limit, for the power curve; else 0.

    """

    kind: str
    difficulty: str
    seed: int
    effects: tuple[tuple[str, float, str], ...] = ()
    course: str = 'poses'
    damage: str = ''
    multibody: bool = False
    gust: bool = False
    tolerance: bool = False
    conditions: str = 'nominal'
    noise: float = 1.0
    command_age: float = 0.0
    duration: float = 60.0
    fit: int = 2
    holdout: int = 1
    multiple: float = 0.0

    def key(self) -> str:
        """Name of its folders: 16 hex digits of what it is and of the generator that makes it."""
        text = json.dumps(asdict(self), sort_keys=True) + fingerprint()
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def accept(self) -> tuple[str, ...]:
        """Verdicts that are right without a name."""
        if self.damage:
            return DAMAGED[self.damage][1]
        none = ('no_gap', *(('not_decidable',) if self.course == 'hover' else ()))
        return {'none': none, 'outside': ('unknown',), 'undecidable': ('not_decidable',),
                'short': ('not_decidable', 'no_gap', 'bad_data')}.get(self.kind, ())

    def allowed(self) -> tuple[str, ...]:
        """Names that are not wrong beside the hidden effects."""
        names = [c for name, _, _ in self.effects for c in COMPANIONS.get(name, ())]
        return tuple(names + (['module_reaction'] if self.multibody else []))


_FINGERPRINT: list[str] = []


def fingerprint() -> str:
    """Of the generator's files, so that a change of theirs makes every flight anew."""
    if not _FINGERPRINT:
        _FINGERPRINT.append(hashlib.sha256(b''.join(
            (HERE / name).read_bytes() for name in GENERATOR)).hexdigest())
    return _FINGERPRINT[0]


def load_settings(path: str | Path = HERE / 'campaign.yaml') -> dict:
    """Everything that stands in ``campaign.yaml``."""
    return yaml.safe_load(Path(path).read_text())


def make_cases(settings: dict, which: str, seed: int, command_age: float,
               most: int | None = None) -> list[Case]:
    """
    Draw the cases of a set.

    Args:
        settings: of ``campaign.yaml``.
        which: a key of its ``sets``.
        seed: of the campaign.
        command_age: [s], see :class:`Case`.
        most: number of cases to take, spread over the kinds; None takes all.

    """
    cases = []
    for difficulty, counts in settings['sets'][which].items():
        for kind, count in counts.items():
            rng = np.random.default_rng([seed, DIFFICULTIES.index(difficulty),
                                         KINDS.index(kind)])
            for k in range(count):
                cases.append(DRAW[kind](settings, difficulty, k, rng, command_age))
    if most is not None and most < len(cases):
        cases = [cases[i] for i in np.linspace(0, len(cases) - 1, most).round().astype(int)]
    return cases


def _base(settings, difficulty, k, rng, command_age, kind, **more) -> Case:
    flights = settings['flights']
    fields = {'kind': kind, 'difficulty': difficulty, 'seed': int(rng.integers(2 ** 31)),
              'command_age': command_age, 'duration': flights['duration'],
              'fit': flights['fit'], 'holdout': flights['holdout']}
    if difficulty == 'hard':
        fields |= {'multibody': True, 'gust': True, 'tolerance': True,
                   'conditions': ('published', 'nominal')[k % 2]}
    return Case(**(fields | more))


def _effect(settings, name, difficulty, rng, multiple=None):
    """Name, signed size and shape; the clean half has the textbook's shapes."""
    entry = settings['effects'][name]
    size = float(np.exp(rng.uniform(*np.log(entry['range']))))
    if multiple is not None:
        size = multiple * entry['limit']
    size *= int(rng.choice(entry['signs']))
    if name == 'mass' and size < 0:
        size = max(size, -0.2)
    if name == 'rotor_lag' and size < 0:
        size = max(size, -0.04)
    shapes = SHAPES.get(name, ()) if difficulty == 'hard' else ()
    return name, size, str(rng.choice(shapes)) if shapes else 'plain'


def _single(settings, difficulty, k, rng, age):
    names = list(settings['effects'])
    order = np.random.default_rng(5).permutation(len(names))  # spread over layers in small sets
    name = names[order[k % len(names)]]
    effect = _effect(settings, name, difficulty, rng)
    plant = {'multibody': True} if name == 'module_reaction' else {}
    return _base(settings, difficulty, k, rng, age, 'singles', effects=(effect,), **plant)


def _none(settings, difficulty, k, rng, age):
    harder = {'noise': 2.0 if k % 3 == 2 else 1.0,
              'course': ('poses', 'lemniscate', 'poses', 'hover')[k % 4]}
    if difficulty == 'hard':    # half calm; now and then without one of the other hardships
        harder |= {'gust': k // 4 % 2 == 0, 'conditions': ('published', 'nominal')[k // 8 % 2],
                   'multibody': k % 5 != 4, 'tolerance': k % 7 != 6}
    return _base(settings, difficulty, k, rng, age, 'none', **harder)


def _pair(settings, difficulty, k, rng, age):
    pair = settings['pairs'][k % len(settings['pairs'])]
    return _base(settings, difficulty, k, rng, age, 'pairs',
                 effects=tuple(_effect(settings, name, difficulty, rng) for name in pair))


def _outside(settings, difficulty, k, rng, age):
    names = list(settings['outside'])
    name = names[k % len(names)]
    size = float(rng.uniform(*settings['outside'][name]['range']))
    return _base(settings, difficulty, k, rng, age, 'outside', effects=((name, size, 'plain'),))


def _undecidable(settings, difficulty, k, rng, age):
    names = list(settings['undecidable'])
    effect = _effect(settings, names[k % len(names)], 'clean', rng)
    return _base(settings, difficulty, k, rng, age, 'undecidable', effects=(effect,),
                 course='hover')


def _short(settings, difficulty, k, rng, age):
    names = list(settings['effects'])
    effect = _effect(settings, names[int(rng.integers(len(names)))], difficulty, rng)
    return _base(settings, difficulty, k, rng, age, 'short', effects=(effect,),
                 duration=settings['flights']['short'], fit=1)


def _damaged(settings, difficulty, k, rng, age):
    damage = list(DAMAGED)[4 * k % len(DAMAGED)]
    name = DAMAGED[damage][0]
    effects = (_effect(settings, name, 'clean', rng),) if name else ()
    return _base(settings, 'clean', k, rng, age, 'damaged', effects=effects, damage=damage,
                 course='rest' if damage == 'rest' else 'poses', fit=1, duration=30.0)


def _power(settings, difficulty, k, rng, age):
    power = settings['power']
    name = power['effects'][k % len(power['effects'])]
    multiple = power['multiples'][k // len(power['effects']) % len(power['multiples'])]
    return _base(settings, difficulty, k, rng, age, 'power', multiple=multiple,
                 effects=(_effect(settings, name, difficulty, rng, multiple),))


DRAW: dict[str, Callable[..., Case]] = {
    'singles': _single, 'none': _none, 'pairs': _pair, 'outside': _outside,
    'undecidable': _undecidable, 'short': _short, 'damaged': _damaged, 'power': _power}
