"""Unusable input of each subcommand: one line with the error, its place and the expectation."""

from io import StringIO
from pathlib import Path
import shlex

import pytest
from synthetic_flights import write_imu

from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.model.resources import share_path

HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'
JOINTS = 't_s,q1_rad,q2_rad,q3_rad,q4_rad,command_rad\n'
FILES = {
    'good.csv': HEADER + '0,0,1,0,0,0\n', 'no_header.csv': '0,0,1,0,0,0\n',
    'twice.csv': HEADER.strip() + ',x_m\n0,0,1,0,0,0,0\n',
    'text.csv': HEADER + '0,0,1,0,0,0\n0,0,1,east,0,0\n',
    'short.csv': HEADER + '0,0,1,0,0\n', 'far.csv': HEADER + '0,0,1,0,0,0\n100,0,1,0,0,0\n',
    'low.csv': HEADER + '0,0,0.05,180,0,0\n', 'below.csv': HEADER + '0,0,-1,0,0,0\n',
    'empty.csv': '', 'header.csv': HEADER, 'binary.csv': b'\xff\xfe\x00x',
    'unknown.yaml': 'masss: 3.0\n', 'binary.yaml': b'\xff\xfe\x00x',
    'effect.yaml': 'extends: robot.yaml\neffects: {rotor_drg: {coefficient: 0.4}}\n',
    'extends.yaml': 'extends: nobody.yaml\nmass: 3.0\n',
    'list.yaml': 'faults: [{kind: mocap_lost}]\n', 'horizon.yaml': 'horizn: 20\n',
    'no_fault.yaml': 'faults: {a: {strike: [{kind: rotor_stop, rotor: 1}]}}\n',
    'rotor_9.yaml': 'faults: {a: {strike: [{kind: rotor_stops, rotor: 9}]}}\n',
    'policy.onnx': b'no network', 'notes.txt': 'nothing', 'not.mcap': b'no bag at all',
    'times.csv': JOINTS + '0,0,0,0,0,0\n0,0,0,0,0,0\n', 'one_joint.csv': JOINTS + '0,0,0,0,0,0\n',
    'word_joint.csv': JOINTS + '0,0,0,0,0,x\n0.01,0,0,0,0,0\n', 'columns.csv': 'a,b\n1,2\n',
    'process.yaml': 'faults: {a: {strike: [{kind: controller_silent, at: 1}]}}\n',
    'device.yaml': 'faults: {a: {strike: [{kind: joints_lost}]}}\n',
    'baud.yaml': share_path('params/servo_bus.yaml').read_text() + '    baud_rate: fast\n',
    'port.yaml': 'prt: /dev/x\n', 'winds.yaml': 'without: [winds]\n'}
DB3 = 'old/old_0.db3'

EVALUATE, COMPARE = 'evaluate --task good.csv', \
    'compare --controllers hover --tasks hover --output out'
FLY, FAULTS, JOINT = 'fly --bag new --task good.csv', 'faults --only mocap_lost', \
    'identify joint times.csv'
# Arguments before, their values, and words of the line.
CASES = {
    f'{EVALUATE} --task': [
        ("''", "--task '': expected"), ('wayponts', "'wayponts': expected a CSV file"),
        ('random0', "'random0': expected a CSV file of poses, a YAML file of poses or set points, "
                    'random1'),
        ('none.csv', 'none.csv: no such file'), ('folder', 'folder: '),
        ('no_header.csv', 'row 1: the header is missing; expected x_m'),
        ('twice.csv', "column 'x_m' occurs twice; expected"),
        ('text.csv', "row 3, column roll_deg: expected a finite number, found 'east'"),
        ('short.csv', 'row 2: expected 6 values, found 5'),
        ('far.csv', 'row 3: |x| = 100 m, expected at most'),
        ('low.csv', 'row 2: z = 0.05 m, expected at least'),
        ('below.csv', 'row 2: z = -1 m, expected at least'),
        ('empty.csv', 'empty.csv: empty; expected the header'),
        ('header.csv', 'no pose below the header; expected at least one row'),
        ('binary.csv', 'binary.csv: not a CSV text file')],
    f'{EVALUATE} --robot': [
        ("''", "'': expected a value"), ('none.yaml', 'none.yaml: no such file'),
        ('folder', 'folder: no such file'), ('binary.yaml', 'binary.yaml: '),
        ('unknown.yaml', "'masss': unknown key; did you mean 'mass'"),
        ('effect.yaml', 'rotor_drg'), ('extends.yaml', 'nobody.yaml')],
    f'{EVALUATE} --seed': [
        ('1.5', "'--seed': Input should be"), ('99999999999', "'--seed': Input should be")],
    f'{EVALUATE} --faults': [
        ('list.yaml', "key 'faults': expected a mapping"),
        ('no_fault.yaml', "did you mean 'rotor_stops'"),
        ('rotor_9.yaml', "key 'rotor': 9 is outside 1 to 4")],
    f'{EVALUATE} --json': [
        ('no/result.json', 'there is no folder'), ('folder', 'it is a folder'),
        ("''", "--json '': expected a value")],
    f'{EVALUATE} --nmpc': [('horizon.yaml', "'horizn': unknown key")],
    f'{EVALUATE} --controllers': [
        ("''", "--controllers '"), ("' , '", "--controllers '"),
        ('nmpc,nmpc', "--controllers '"),
        ('npmc', "controller 'npmc': expected one of nmpc"), ('none.py:Mine', 'none.py'),
        ('no_module:Mine', 'no_module'), ('rl --policy none.onnx', "'none.onnx' does not exist"),
        ('rl --policy policy.onnx', "metadata 'checksum' is missing"),
        ('hover --nmpc horizon.yaml', '--nmpc horizon.yaml'),
        ('hover --policy policy.onnx', '--policy policy.onnx')],
    EVALUATE: [
        ('--controller npmc', "'npmc': expected one of nmpc"), ('--plant unknown.yaml', 'masss'),
        ('--conditions windy', "--conditions 'windy': expected nominal or"),
        ('--sed 1', '--sed'), ('--seed', '--seed'), ('extra', 'extra'),
        ('--bag folder', 'folder: exists already; a bag needs a new folder'),
        ('--bag notes.txt/bag', 'is not a folder')],
    FLY: [
        ('--task text.csv', 'row 3'), ('--robot unknown.yaml', 'masss'),
        ('--controller npmc', "controller 'npmc': expected one of nmpc"),
        ('--controllers npmc', "controller 'npmc': expected one of nmpc"),
        ('--faults process.yaml', 'expected a fault of the robot'),
        ('--faults device.yaml --actuators emulated', 'expected --actuators direct'),
        ('--actuators steam', "actuators 'steam': expected emulated or direct"),
        ('--clock sun', "clock 'sun': expected auto or system or simulated"),
        ('--domain-id 102', "'--domain-id': Input"),
        ('--clock simulated --actuators emulated', 'serial devices keep real')],
    COMPARE: [
        ("--controllers ''", "--controllers '': expected"), ('--tasks hovr', 'hovr'),
        ('--controllers npmc', 'npmc'), ('--tasks hover,hover', "--tasks 'hover,hover'"),
        ('--seeds 0,x', "'x'"), ('--seeds -1', "'-1'"), ('--conditions windy', 'windy'),
        ('--jobs 0', "'--jobs' / '-j': Input should be"),
        ('--policy none.onnx', "'none.onnx' does not exist"), ('--output notes.txt', 'notes'),
        ('--json no/result.json', 'there is no folder')],
    FAULTS: [
        ('--faults list.yaml', "key 'faults': expected a mapping"),
        ('--only rotor_9_stops', "unknown fault 'rotor_9_stops'; did you mean 'rotor_4_stops'"),
        ('--from bed', "--from 'bed': expected hover, moving, upside_down"),
        ('--seeds 0', "'--seeds': Input should be"), ('--healthy nan', "'--healthy'"),
        ('--controller npmc', 'npmc'), ('--output notes.txt', 'notes.txt'),
        ('--json folder', 'it is a folder'), ('--bags', '--bags: expected --output')],
    'report': [
        ('', "'RUN...'"), ('none', 'none: no such bag'),
        ('folder', 'folder: no .mcap file in this folder'),
        ('notes.txt', 'notes.txt: expected a rosbag2 folder'),
        ('old', 'convert it with ros2 bag'), ('not.mcap', 'not.mcap: not an MCAP file'),
        ('imu_only', 'ground_truth/odom'), (' '.join(['imu_only'] * 7), 'at most'),
        ('imu_only --output no/page.html', 'page.html')],
    'view': [
        ('none', 'none: no such bag'),
        ('imu_only --namespace a', '--namespace: expected without'),
        ('--rerun', '--rerun: expected RUN')],
    'gap': [
        ('', "'RUN...'"), ('none', 'none: no such bag'), ('imu_only imu_only', 'imu_only'),
        ('imu_only --robot unknown.yaml', 'masss'), ('imu_only --gap unknown.yaml', 'masss'),
        ('imu_only --gap winds.yaml', "'without': unknown effect; did you mean 'wind'"),
        ('imu_only --apply no/robot.yaml', 'there is no folder'),
        ('imu_only --report folder', 'it is a folder')],
    'identify': [
        ('engine', 'engine'), ('joint', 'LOG'), ('rotor', 'LOG.csv'),
        ('joint one_joint.csv', 'one_joint.csv'), ('joint word_joint.csv', 'word_joint.csv'),
        *((f'{kind} {name}.csv', f'{name}.csv') for kind in ('joint', 'rotor')
          for name in ('none', 'columns', 'empty', 'binary'))],
    JOINT: [
        ('', 'times.csv'), ('--robot none.yaml', 'none.yaml'),
        ('--params no/robot.yaml', 'there is no folder'), ('--report folder', 'it is a folder')],
    'check': [
        ('--seconds 0', "'--seconds': Input"), ('--skip legs', "--skip 'legs': expected"),
        ('--servo-bus baud.yaml', 'baud_rate'), ('--motor-board port.yaml', "'prt': unknown"),
        ('--robot unknown.yaml', 'masss'), ('--json no/x.json', 'there is no folder')],
    'drive': [
        ('wheel', "source 'wheel': expected keyboard or joystick or terminal"),
        ('keyboard', 'standard input is no terminal'),
        ('terminal --params none.yaml', 'none.yaml'), ('terminal --domain-id 300', 'Input')],
    '': [('frobnicate', 'frobnicate'), ('--nonsense', '--nonsense')]}
ROWS = [(f'{before} {value}', fragment) for before, cases in CASES.items()
        for value, fragment in cases]
EXPECTATIONS = ('expected', 'See beetle_omni', 'no such', 'known', 'needs', 'there is no folder',
                'it is a folder', 'not a', 'no .mcap', 'ros2 bag', 'at most', 'cannot',
                'no module', 'missing', 'outside', 'beside it or among')


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


@pytest.mark.parametrize(('arguments', 'fragment'), ROWS, ids=[row[0] for row in ROWS])
def test_unusable_input_is_one_line_and_writes_nothing(arguments, fragment, inputs, monkeypatch,
                                                       capsys):
    arguments = shlex.split(arguments)
    if arguments[0] in ('fly', 'drive', 'check'):
        pytest.importorskip('serial' if arguments[0] == 'check' else 'rclpy')
    monkeypatch.setattr('sys.stdin', StringIO())
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
