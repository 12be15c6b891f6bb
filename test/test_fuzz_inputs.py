"""Damaged input files are read, or refused in one line; nothing else is raised."""

from pathlib import Path

import numpy as np
from synthetic_flights import fly
from test_packaging import parameter_classes

from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.view.report import make_page, make_runs, results_of

LONGEST_TEXT = 2000     # characters of a refusal
LAUGHS = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{two}: &{two} [{", ".join(["*" + one] * 9)}]\n' for one, two in zip('abcdefgh', 'bcdefghi'))
# Values that have broken a reader somewhere.
VALUES = ('.nan', '.inf', '-.inf', '3', '-1', '0', '1e400', '9' * 5000, '0x' + 'f' * 9000, '0b_',
          '[]', '{}', '[[]]', '[1, [2]]', '{a: 1}', '""', 'x', "'" + 'x' * 9000 + "'", 'null',
          'true', '2001-13-99', '2001-01-01', '!!bool x', '!!timestamp x', '!!int ""', '~',
          '!!python/object:os.system {}', '!!binary x', '*nowhere', '&a [*a]', '[' * 60 + ']' * 60,
          '[' * 5000, '1:90', '<<', '? {a: b}', '"\\0"', '[.nan, 1]', '[x, 1, 2]', '!!set {a, b}')


def mutate_bytes(rng, data, changes=5, longest=39):
    """Flip, cut out, repeat or replace some bytes."""
    data = bytearray(data)
    for _ in range(rng.integers(1, changes + 1)):
        at, length = int(rng.integers(len(data) + 1)), int(rng.integers(1, longest + 1))
        match rng.integers(5):
            case 0 if at < len(data):
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                del data[at:at + length]
            case 2:
                data[at:at] = data[at:at + length]
            case 3:
                data[at:at + length] = rng.bytes(length)
            case 4 if rng.random() < 0.2:
                del data[at:]
    return bytes(data)


def mutate_yaml(rng, data):
    """Replace a value or key by a hostile one, shuffle lines, or mutate bytes."""
    lines = data.decode().splitlines()
    at = int(rng.integers(len(lines)))
    value = VALUES[rng.integers(len(VALUES))]
    key, colon, _ = lines[at].partition(':')
    match rng.integers(7):
        case 0 | 1 | 2:
            lines[at] = f'{key}: {value}' if colon and '#' not in key else value
        case 3:
            lines[at] = f'{value}{colon}{lines[at][len(key) + 1:]}'
        case 4:
            lines[at:at] = LAUGHS.splitlines() + [f'{key}: *i']
        case 5:
            lines[at] = ('  ' * int(rng.integers(4))) + lines[rng.integers(len(lines))].lstrip()
        case 6:
            return mutate_bytes(rng, data)
    return '\n'.join([*lines, '']).encode()


def read_flight(path):
    """Read a bag, compute metrics and draw the page, like ``beetle_omni report``."""
    with np.errstate(all='ignore'):
        runs = make_runs({'run': read_bag(path)})
        return runs, results_of(runs)


def check(path, read):
    """Read a file; True if it was refused, by one bounded line."""
    try:
        read(path)
    except ParameterError as error:
        text = str(error)
        assert '\n' not in text and len(text) <= LONGEST_TEXT, path
        return True
    return False


def refusals(count, folder, suffix, sources, mutate, read):
    """Number of ``count`` damaged files that were refused."""
    refused = 0
    for k in range(count):
        rng = np.random.default_rng([1, k])
        name = sorted(sources)[rng.integers(len(sources))]
        path = folder / f'{Path(name).stem}_{k}{suffix}'
        path.write_bytes(mutate(rng, sources[name]))
        refused += check(path, lambda file, name=name: read(file, name))
    return refused


def test_a_damaged_parameter_file_is_refused_in_one_line(tmp_path):
    classes = parameter_classes()
    sources = {name: share_path(f'params/{name}').read_bytes() for name in classes}
    assert refusals(80, tmp_path, '.yaml', sources, mutate_yaml,
                    lambda path, name: classes[name].load(path))


def test_a_damaged_bag_is_read_up_to_the_damage(tmp_path):
    with BagWriter(tmp_path / 'bag', {'task': 'waypoints', 'seed': 1}) as writer:
        fly(writer, make_task('waypoints'), duration=3.0)
    bag = (tmp_path / 'bag' / 'bag.mcap').read_bytes()
    refusals(8, tmp_path, '.mcap', {'bag': bag}, mutate_bytes,
             lambda path, _: make_page(*read_flight(path)))
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    sound = metadata.read_bytes()
    for k in range(6):
        metadata.write_bytes(mutate_yaml(np.random.default_rng([1, k]), sound))
        check(tmp_path / 'bag', read_flight)
