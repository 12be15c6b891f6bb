"""Damaged input files are read, or refused in one line; nothing else is raised."""

import numpy as np
from synthetic_flights import fly
from test_packaging import parameter_classes

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.report import make_page, make_runs, results_of

LONGEST_TEXT = 2000     # characters of a refusal
LAUGHS = ['a: &a [x, x, x, x, x, x, x, x, x]', *(
    f'{two}: &{two} [{", ".join(["*" + one] * 9)}]' for one, two in zip('abcdefgh', 'bcdefghi'))]
# Values that have broken a reader somewhere.
VALUES = ('.nan', '-.inf', '-1', '0', '1e400', '9' * 5000, '0b_', '[[]]', '[1, [2]]',
          '{a: 1}', '""', "'" + 'x' * 9000 + "'", 'null', 'true', '2001-13-99',
          '!!bool x', '!!timestamp x', '!!int ""', '!!python/object:os.system {}', '!!binary x',
          '*nowhere', '&a [*a]', '[' * 5000, '1:90', '<<', '? {a: b}', '"\\0"', '[.nan, 1]')


def mutate_bytes(rng, data):
    """Flip, cut out or repeat some bytes, or cut off the rest."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at, length = int(rng.integers(len(data))), int(rng.integers(1, 40))
        match rng.integers(10):
            case 0:
                del data[at:]
            case 1 | 2:
                del data[at:at + length]
            case 3 | 4:
                data[at:at] = data[at:at + length]
            case _:
                data[at:at + 1] = rng.bytes(1)
    return bytes(data) or b'x'


def mutate_yaml(rng, data):
    """Replace a value by a hostile one, indent a line, or mutate bytes."""
    lines = data.decode().splitlines()
    at = int(rng.integers(len(lines)))
    key = lines[at].partition(':')[0]
    match rng.integers(6):
        case 0:
            return mutate_bytes(rng, data)
        case 1:
            lines[at:at] = [*LAUGHS, f'{key}: *i']
        case 2:
            lines[at] = '  ' * int(rng.integers(1, 4)) + lines[at].lstrip()
        case _:
            lines[at] = f'{key}: {VALUES[rng.integers(len(VALUES))]}'
    return '\n'.join([*lines, '']).encode()


def refused(read, path):
    """Read a file; True if it was refused, by one bounded line."""
    try:
        with np.errstate(all='ignore'):
            read(path)
    except ParameterError as error:
        assert '\n' not in str(error) and len(str(error)) <= LONGEST_TEXT, path
        return True
    return False


def test_a_damaged_parameter_file_is_refused_in_one_line(tmp_path):
    classes, counts = list(parameter_classes().items()), []
    for k in range(80):
        rng = np.random.default_rng([1, k])
        name, kind = classes[rng.integers(len(classes))]
        path = tmp_path / f'{k}.yaml'
        path.write_bytes(mutate_yaml(rng, share_path(f'params/{name}').read_bytes()))
        counts.append(refused(kind.load, path))
    assert sum(counts) > 20


def test_a_damaged_bag_is_read_up_to_the_damage(tmp_path):
    def report(path, with_page):
        runs = make_runs({'run': read_bag(path)})
        results = results_of(runs)
        if with_page:       # which takes seconds
            make_page(runs, results)

    with BagWriter(tmp_path / 'bag', {'task': 'waypoints', 'seed': 1}) as writer:
        fly(writer, make_task('waypoints'), duration=1.0)
    for name, mutate in (('bag.mcap', mutate_bytes), ('metadata.yaml', mutate_yaml)):
        sound = (tmp_path / 'bag' / name).read_bytes()
        for k in range(12):
            (tmp_path / 'bag' / name).write_bytes(mutate(np.random.default_rng([1, k]), sound))
            refused(lambda path, k=k: report(path, k < 3), tmp_path / 'bag')
        (tmp_path / 'bag' / name).write_bytes(sound)
