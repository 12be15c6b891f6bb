"""Unusable input of each subcommand: one line with the error, its place and the expectation."""

from pathlib import Path

import pytest
from synthetic_flights import write_imu

from beetle_omni_ros import cli
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.runs.bag_writer import BagWriter

HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'
JOINTS = 't_s,q1_rad,q2_rad,q3_rad,q4_rad,command_rad\n'
FILES = {
    'good.csv': HEADER + '0,0,1,0,0,0\n',
    'no_header.csv': '0,0,1,0,0,0\n', 'unknown.csv': HEADER.replace('x_m', 'x') + '0,0,1,0,0,0\n',
    'missing.csv': 'x_m,y_m,z_m,roll_deg,pitch_deg\n0,0,1,0,0\n',
    'twice.csv': HEADER.strip() + ',x_m\n0,0,1,0,0,0,0\n',
    'text.csv': HEADER + '0,0,1,0,0,0\n0,0,1,east,0,0\n', 'nan.csv': HEADER + '0,nan,1,0,0,0\n',
    'short.csv': HEADER + '0,0,1,0,0\n', 'far.csv': HEADER + '0,0,1,0,0,0\n100,0,1,0,0,0\n',
    'low.csv': HEADER + '0,0,0.05,180,0,0\n', 'below.csv': HEADER + '0,0,-1,0,0,0\n',
    'empty.csv': '', 'header.csv': HEADER, 'binary.csv': b'\xff\xfe\x00x',
    'broken.yaml': 'mass: [1\n', 'list.yaml': '- 1\n', 'unknown.yaml': 'masss: 3.0\n',
    'negative.yaml': 'extends: robot.yaml\nmass: -1.0\n', 'binary.yaml': b'\xff\xfe\x00x',
    'word.yaml': 'extends: robot.yaml\nmass: heavy\n',
    'effect.yaml': 'extends: robot.yaml\neffects: {rotor_drg: {coefficient: 0.4}}\n',
    'effect_number.yaml': 'extends: robot.yaml\neffects: {rotor_drag: {coefficient: much}}\n',
    'extends.yaml': 'extends: nobody.yaml\nmass: 3.0\n',
    'no_list.yaml': 'faults: 3\n', 'no_fault.yaml': 'faults: [{what: rotor_stop, rotor: 1}]\n',
    'no_rotor.yaml': 'faults: [{what: rotor_stops}]\n', 'key.yaml': 'fault: []\n',
    'rotor_9.yaml': 'faults: [{what: rotor_stops, rotor: 9}]\n',
    'before.yaml': 'faults: [{what: mocap_lost, at: -1}]\n', 'horizon.yaml': 'horizn: 20\n',
    'policy.onnx': b'no network', 'notes.txt': 'nothing', 'not.mcap': b'no bag at all',
    'times.csv': JOINTS + '0,0,0,0,0,0\n0,0,0,0,0,0\n', 'one_joint.csv': JOINTS + '0,0,0,0,0,0\n',
    'word_joint.csv': JOINTS + '0,0,0,0,0,x\n0.01,0,0,0,0,0\n', 'columns.csv': 'a,b\n1,2\n',
    'process.yaml': 'faults: [{what: controller_silent, at: 1}]\n',
    'device.yaml': 'faults: [{what: joints_lost}]\n',
    'baud.yaml': share_path('params/servo_bus.yaml').read_text() + '    baud_rate: fast\n',
    'ids.yaml': 'ids: [1, 2, 3]\n', 'port.yaml': 'prt: /dev/x\n'}
DB3 = 'old/old_0.db3'

EVALUATE, FLY, COMPARE = ['evaluate', '--task', 'good.csv'], ['fly', '--bag', 'new'], \
    ['compare', '--controllers', 'hover', '--tasks', 'hover', '--output', 'out']
TASKS = [
    ('', "--task '': expected"), ('wayponts', "'wayponts': expected a CSV file"),
    ('random0', "'random0': expected a CSV file of poses, random1 to random999999"),
    ('random1000000', 'random1 to random999999'), ('random-3', 'random1 to random999999'),
    ('none.csv', 'none.csv: no such file'), ('folder', 'folder: '),
    ('no_header.csv', 'row 1: the header is missing; expected x_m'),
    ('unknown.csv', "row 1: column 'x_m' is missing; expected x_m"),
    ('missing.csv', "row 1: column 'yaw_deg' is missing; expected"),
    ('twice.csv', "column 'x_m' occurs twice; expected"),
    ('text.csv', "row 3, column roll_deg: expected a finite number, found 'east'"),
    ('nan.csv', "row 2, column y_m: expected a finite number, found 'nan'"),
    ('short.csv', 'row 2: expected 6 values, found 5'),
    ('far.csv', 'row 3: |x| = 100 m, expected at most'),
    ('low.csv', 'row 2: z = 0.05 m, expected at least'),
    ('below.csv', 'row 2, column z_m: expected a height above the floor, found -1'),
    ('empty.csv', 'empty.csv: empty; expected the header'),
    ('header.csv', 'no pose below the header; expected at least one row'),
    ('binary.csv', 'binary.csv: not a CSV text file')]
ROBOTS = [
    ('', "'': expected a value"), ('none.yaml', 'none.yaml: no such file'),
    ('folder', 'folder: no such file'), ('broken.yaml', 'broken.yaml: '),
    ('list.yaml', 'list.yaml: expected a mapping of keys, found list'),
    ('unknown.yaml', "'masss': unknown key; did you mean 'mass'"),
    ('negative.yaml', "'mass': -1 is outside"), ('binary.yaml', 'binary.yaml: '),
    ('word.yaml', "'mass': expected"), ('effect.yaml', 'rotor_drg'),
    ('effect_number.yaml', 'coefficient'), ('extends.yaml', 'nobody.yaml')]
SEEDS = [('1.5', "--seed '1.5': expected"), ('x', "--seed 'x': expected"),
         ('-1', "--seed '-1': expected"), ('99999999999', "--seed '99999999999': expected"),
         ('', "--seed '': expected a value")]
FAULTS = [
    ('none.yaml', 'none.yaml: no such file'), ('no_list.yaml', "key 'faults': expected a list"),
    ('no_fault.yaml', 'near: rotor_stops'), ('no_rotor.yaml', "key 'rotor' is missing"),
    ('key.yaml', "key 'fault': unknown key; known: faults"),
    ('rotor_9.yaml', "key 'rotor': 9 is outside 1 to 4"),
    ('before.yaml', "key 'at': -1 is outside"), ('broken.yaml', 'broken.yaml: ')]
RESULTS = [('no/result.json', 'there is no folder'), ('folder', 'it is a folder'),
           ('', "--json '': expected a value")]
RUNS = [('none', 'none: no such bag'), ('folder', 'folder: no .mcap file in this folder'),
        ('notes.txt', 'notes.txt: expected a rosbag2 folder'), ('old', 'convert it with ros2 bag'),
        ('not.mcap', 'not.mcap: not an MCAP file'), ('', "'': expected a value")]


def rows():
    """(arguments, expected words of the line) of each case."""
    for command, controller in ((EVALUATE, '--controllers'), (FLY, '--controller')):
        base = command if command is EVALUATE else [*FLY, '--task', 'good.csv']
        for option, cases in (('--task', TASKS), ('--robot', ROBOTS), ('--seed', SEEDS),
                              ('--json', RESULTS), ('--plant', ROBOTS[1:6])):
            for value, fragment in cases:
                yield [*base, option, value], fragment
        for value, fragment in FAULTS:
            yield [*base, '--faults', value], fragment
        if controller == '--controller':        # what a flight through ROS cannot simulate
            yield [*base, '--faults', 'process.yaml'], 'expected a fault of the robot'
            yield [*base, '--faults', 'device.yaml', '--actuators', 'emulated'], \
                'expected --actuators direct'
        yield [*base, '--conditions', 'windy'], "--conditions 'windy': expected nominal or"
        yield [*base, '--compression', 'rar'], "compression 'rar': expected none or zstd"
        yield [*base, '--sed', '1'], '--sed'
        yield [*base, '--seed'], '--seed'
        yield [*base, 'extra'], 'extra'
        yield [*base, controller, 'npmc'], "controller 'npmc': expected one of nmpc"
        yield [*base, controller, 'none.py:Mine'], 'none.py'
        yield [*base, controller, 'no_module:Mine'], 'no_module'
        yield [*base, controller, 'rl', '--policy', 'none.onnx'], 'none.onnx: no such file'
        yield [*base, controller, 'rl', '--policy', 'policy.onnx'], 'no policy'
        yield [*base, '--bag', 'folder'], 'folder: exists already; a bag needs a new folder'
        yield [*base, '--bag', 'notes.txt/bag'], 'is not a folder'
    for value in ('', ' , ', 'nmpc,nmpc'):
        yield [*EVALUATE, '--controllers', value], "--controllers '"
    for value, fragment in (('none.yaml', 'no such file'),
                            ('horizon.yaml', "'horizn': unknown key"),
                            ('broken.yaml', 'broken.yaml: ')):
        yield [*EVALUATE, '--nmpc', value], fragment
    for option, file in (('--nmpc', 'horizon.yaml'), ('--policy', 'policy.onnx')):
        yield [*EVALUATE, '--controllers', 'hover', option, file], f'{option} {file}'
    for option, value, fragment in (
            ('--actuators', 'steam', "actuators 'steam': expected emulated or direct"),
            ('--clock', 'sun', "clock 'sun': expected auto or system or simulated"),
            ('--domain-id', '102', "--domain-id '102': expected"),
            ('--domain-id', 'x', "--domain-id 'x': expected"),
            ('--discovery', 'OFF', '--discovery OFF'), ('--discovery', 'MARS', 'MARS')):
        yield [*FLY, '--task', 'good.csv', option, value], fragment
    yield [*FLY, '--clock', 'simulated', '--actuators', 'emulated'], 'serial devices keep real'
    for option, value, fragment in (
            ('--controllers', '', "--controllers '': expected"), ('--tasks', 'hovr', 'hovr'),
            ('--controllers', 'npmc', 'npmc'), ('--tasks', 'hover,hover', "--tasks 'hover,hover'"),
            ('--tasks', 'text.csv', 'row 3, column roll_deg: expected'), ('--seeds', '0,x', "'x'"),
            ('--seeds', '1.5', "--seeds '1.5': expected whole numbers"), ('--seeds', '-1', "'-1'"),
            ('--conditions', 'windy', 'windy'), ('--jobs', '0', "--jobs '0': expected"),
            ('--jobs', 'two', "--jobs 'two': expected"), ('--backend', 'threads', 'threads'),
            ('--policy', 'none.onnx', 'none.onnx: no such file'),
            ('--output', 'notes.txt', 'notes'),
            ('--json', 'no/result.json', 'there is no folder')):
        yield [*COMPARE, option, value], fragment
    for option, value, fragment in (
            ('--faults', 'none.yaml', 'none.yaml'), ('--faults', 'no_list.yaml', "'faults'"),
            ('--only', 'rotor_9_stops', "fault 'rotor_9_stops' is unknown, a name of the list is "
                                         'expected; near: rotor_4_stops'),
            ('--from', 'bed', "--from 'bed': expected hover, moving, upside_down"),
            ('--seeds', '0', "--seeds '0': expected"), ('--seeds', 'x', "--seeds 'x': expected"),
            ('--landings', '-1', "--landings '-1': expected"),
            ('--healthy', 'nan', "--healthy 'nan'"),
            ('--healthy', '-1', "--healthy '-1': expected"),
            ('--conditions', 'windy', 'windy'), ('--controller', 'npmc', 'npmc'),
            ('--output', 'notes.txt', 'notes.txt'),
            ('--jobs', '0', "--jobs '0': expected"), ('--json', 'folder', 'it is a folder')):
        yield ['faults', '--only', 'mocap_lost', option, value], fragment
    yield ['faults', '--only', 'mocap_lost', '--bags'], '--bags: expected --output'
    for command in ('report', 'gap'):
        yield [command], "'RUN...'"
        for value, fragment in RUNS:
            yield [command, value], fragment
        yield [command, 'imu_only', '--json', 'no/result.json'], 'there is no folder'
    yield ['report', 'imu_only'], 'ground_truth/odom'
    yield ['report', *['imu_only'] * 7], 'at most'
    yield ['report', 'imu_only', '--output', 'no/page.html'], 'page.html'
    yield ['gap', 'imu_only', 'imu_only'], 'imu_only'
    for option, value, fragment in (
            ('--robot', 'none.yaml', 'none.yaml'), ('--robot', 'unknown.yaml', 'masss'),
            ('--apply', 'no/robot.yaml', 'there is no folder'),
            ('--gap', 'none.yaml', 'none.yaml'),
            ('--gap', 'unknown.yaml', 'masss'), ('--report', 'folder', 'it is a folder')):
        yield ['gap', 'imu_only', option, value], fragment
    yield ['identify', 'engine'], 'engine'
    for kind, metavar in (('joint', 'LOG'), ('rotor', 'LOG.csv')):
        yield ['identify', kind], metavar
        for value, fragment in (('none.csv', 'none.csv'), ('', "'': expected a value"),
                            ('columns.csv', 'columns.csv'), ('empty.csv', 'empty.csv'),
                            ('binary.csv', 'binary.csv'), ('folder', 'folder')):
            yield ['identify', kind, value], fragment
        for option, value, fragment in (
                ('--robot', 'none.yaml', 'none.yaml'), ('--robot', 'negative.yaml', "'mass'"),
                ('--params', 'no/robot.yaml', 'there is no folder'),
                ('--report', 'folder', 'it is a folder'), ('--json', 'folder', 'it is a folder')):
            yield ['identify', kind, 'times.csv', option, value], fragment
    for value, fragment in (('times.csv', 'times.csv'), ('one_joint.csv', 'one_joint.csv'),
                        ('word_joint.csv', 'word_joint.csv')):
        yield ['identify', 'joint', value], fragment
    for option, value, fragment in (
            ('--seconds', '0', "--seconds '0': expected"), ('--seconds', 'x', "--seconds 'x'"),
            ('--seconds', 'nan', "--seconds 'nan'"), ('--skip', 'legs', "--skip 'legs': expected"),
            ('--servo-bus', 'none.yaml', 'none.yaml'), ('--servo-bus', 'baud.yaml', 'baud_rate'),
            ('--servo-bus', 'ids.yaml', 'ids'), ('--motor-board', 'port.yaml', "'prt': unknown"),
            ('--robot', 'unknown.yaml', 'masss'), ('--json', 'no/x.json', 'there is no folder')):
        yield ['check', option, value], fragment
    yield ['controllers', 'nmpc'], 'nmpc'
    yield ['controllers', '--json', 'folder'], 'it is a folder'
    yield ['frobnicate'], 'frobnicate'
    yield ['--nonsense'], '--nonsense'


ROWS = list(rows())
EXPECTATIONS = ('expected', 'See beetle_omni', 'no such', 'known', 'needs', 'there is no folder',
                'it is a folder', 'not a', 'no .mcap', 'ros2 bag', 'at most', 'cannot',
                'no module', 'missing', 'outside', 'beside it or among')
TRAINING = [
    ([], '--output'), (['--output', 'out', '--set', 'a'], "--set 'a': expected key=value"),
    (['--output', 'out', '--set', 'itertions=3'], 'itertions'),
    (['--output', 'out', '--set', 'iterations=many'], 'iterations'),
    (['--output', 'out', '--config', 'none.yaml'], 'none.yaml'),
    (['--output', 'out', '--config', 'unknown.yaml'], 'masss'),
    (['--output', 'out', '--robot', 'none.yaml'], 'none.yaml'),
    (['--output', 'out', '--device', 'abacus'], "--device 'abacus': expected"),
    (['--output', 'out', '--seed', 'x'], "--seed 'x': expected"),
    (['--output', 'out', '--stop-after', '-1'], "--stop-after '-1': expected"),
    (['--output', 'notes.txt'], 'notes.txt'), (['--resume', 'none'], '--resume none'),
    (['--output', 'out', '--json', 'no/x.json'], 'there is no folder')]


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    """A folder with every file of the cases."""
    folder = tmp_path_factory.mktemp('inputs')
    for name, content in FILES.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / 'folder').mkdir()
    (folder / DB3).parent.mkdir()
    (folder / DB3).touch()
    with BagWriter(folder / 'imu_only') as writer:
        write_imu(writer, 1.0, (0, 0, 9.8), (0, 0, 0))
    return folder


def refused(arguments, fragment, inputs, monkeypatch, capsys):
    """Check one case: status 2, one line with its words, and no written file."""
    monkeypatch.chdir(inputs)
    before = sorted(Path().rglob('*'))
    status = cli.main(arguments)
    lines = capsys.readouterr().err.splitlines()
    assert status == 2, lines
    assert len(lines) == 1, lines
    assert fragment in lines[0], lines[0]
    assert any(word in lines[0] for word in EXPECTATIONS), lines[0]
    assert lines[0].startswith('beetle_omni') and ': error: ' in lines[0]
    assert sorted(Path().rglob('*')) == before


@pytest.mark.parametrize(('arguments', 'fragment'), ROWS, ids=[' '.join(row[0]) for row in ROWS])
def test_unusable_input_is_one_line(arguments, fragment, inputs, monkeypatch, capsys):
    if arguments[0] == 'fly':
        pytest.importorskip('rclpy')
    if arguments[0] == 'check':
        pytest.importorskip('serial')
    refused(arguments, fragment, inputs, monkeypatch, capsys)


@pytest.mark.parametrize(('arguments', 'fragment'), TRAINING,
                         ids=[' '.join(row[0]) for row in TRAINING])
def test_unusable_input_of_train_is_one_line(arguments, fragment, inputs, monkeypatch, capsys):
    pytest.importorskip('torch')
    refused(['train', *arguments], fragment, inputs, monkeypatch, capsys)
