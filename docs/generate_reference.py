"""
Pages of docs/reference that are made from code, for docs/hooks.py.

``python docs/generate_reference.py`` writes those that the repository has in full. With the name
of a page, for example ``parameters``, it prints this page. ROS is not needed.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from importlib import import_module
import inspect
from pathlib import Path
import re
import sys
from textwrap import fill

import numpy as np

from beetle_omni_ros.bags import topics as message_topics
from beetle_omni_ros.bags.topics import controller_of, TABLE
from beetle_omni_ros.model.resources import PACKAGE

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / 'docs' / 'reference'
MADE = '<!-- Made by docs/generate_reference.py; changes by hand are lost. -->\n'

# Parameter file -> class that reads it, what it holds.
FILES = {
    'robot.yaml': ('model.parameters:RobotParameters', 'The robot.'),
    'robot_measured.yaml': ('model.parameters:RobotParameters',
                            'The robot as measured logs show it.'),
    'robot_weak_and_heavy.yaml': ('model.parameters:RobotParameters',
                                  'A robot with less thrust and more mass than in robot.yaml.'),
    'crazyflie.yaml': ('model.parameters:RobotParameters',
                       'A conventional quadrotor, for recordings of others.'),
    'nmpc.yaml': ('control.nmpc:NmpcParameters', 'The NMPC.'),
    'nmpc_published.yaml': ('control.nmpc:NmpcParameters',
                            'The NMPC with the settings of the publication.'),
    'nmpc_corrected.yaml': ('control.nmpc:NmpcParameters',
                            'The same with one other weight.'),
    'rl.yaml': ('control.policy:PolicyParameters', 'The policy and its guidance.'),
    'rl_bare.yaml': ('control.policy:PolicyParameters', 'The policy without guidance.'),
    'rl_any.yaml': ('control.policy:PolicyParameters',
                       'The policy with the estimated disturbance as input.'),
    'rl_published.yaml': ('control.policy:PolicyParameters',
                          'The policy of train_published.yaml.'),
    'hover.yaml': ('control.hover:HoverParameters', 'The hover controller.'),
    'ekf.yaml': ('estimation.parameters:EkfParameters', 'The estimator.'),
    'supervisor.yaml': ('supervisor.interface:SupervisorParameters',
                        'Checks of commands, takeoff, landing, detection of faults.'),
    'targets.yaml': ('control.targets:TargetLimits', 'What a target pose must keep to.'),
    'drive.yaml': ('ros.drive:DriveParameters', 'Driving by hand.'),
    'servo_bus.yaml': ('drivers.device_parameters:ServoBusParameters', 'The bus of tilt servos.'),
    'motor_board.yaml': ('drivers.device_parameters:MotorBoardParameters',
                         'The motor board.'),
    'simulator.yaml': ('sim.parameters:SimulatorParameters', 'The simulated world.'),
    'recording.yaml': ('identify.recording.parameters:RecordingLimits',
                       'Limits of the checks of a recording against itself.'),
    'train.yaml': ('train.parameters:TrainParameters', 'The training of a policy.'),
    'train_any.yaml': ('train.parameters:TrainParameters',
                       'The training for robots that differ.'),
    'train_published.yaml': ('train.parameters:TrainParameters',
                             'The training with the settings of the publication.'),
    'gap.yaml': ('identify.recording.parameters:GapParameters', 'The gap finder.')}

ROBOT_FILE = """`mass`, `inertia` and `rotors.positions` are authoritative. With `multibody`, the
simulated main body is what modules and end-effector leave of them. A file that extends another
keeps each number that it does not state: beside a changed `mass` or `rotors.positions`, state the
`inertia`.

"""

# Topics that viewers and clocks need, which no other part of the package reads.
OTHERS = {
    '/clock': ('rosgraph_msgs/Clock', 'SENSOR', 'simulated time, with `--clock simulated`'),
    '/rosout': ('rcl_interfaces/Log', 'LATCHED', 'lines of the log of every node; in the bag of '
                'a flight through ROS'),
    '/tf': ('tf2_msgs/TFMessage', 'EVENT', 'moving frames: `world`, `base_link`, each '
            'tilting module; 50 Hz, in each bag'),
    '/tf_static': ('tf2_msgs/TFMessage', 'LATCHED',
                   'fixed frames: rotors, main body, end effector, IMU'),
    'robot_description': ('std_msgs/String', 'LATCHED', 'URDF for viewers')}


CONVENTIONS = """Names are relative; a launch argument sets a namespace. On the robot, the drivers
of MoCap and IMU publish `mocap/pose` and `imu/data_raw` in place of `sim_node`.

- Units are SI, angles are radians, times are seconds.
- Axes follow REP-103: x forward, y left, z up. `world` is the frame of the MoCap, with z up.
- `base_link` is at the centre of gravity.
- Quaternions are (x, y, z, w).
- A command is one `sensor_msgs/JointState` with `name = [gimbal1..4, rotor1..4]`. `position` holds
  the four tilt targets [rad], then four NaN. `effort` holds four NaN, then the four thrust targets
  [N]. `velocity` is empty.
- The stamp of a command is the time of the state estimate from which it was computed.
"""
STATUS = """\
`beetle_omni` is also `ros2 run beetle_omni_ros beetle_omni`. Each subcommand has `--help`.

| exit status | meaning |
| --- | --- |
| 0 | success |
| 1 | a flight failed or crashed, or a check failed |
| 2 | unusable input; one line on standard error |
| 3 | `gap`: the verdict `bad_data` |
| 130 | interrupted |
"""
TIMES = """The functions of `import beetle_omni_ros as bo`, which `help` shows too. They need no
ROS. Short scripts and a notebook are in `examples/`.

The times of a flight begin at 0, its first sample; `log.epoch` is this moment in seconds since
1970-01-01 UTC on the clock of the flight. The times of a `TrajectoryTarget`, and the argument of
`target.at(t)`, are on the same clock. A `NotebookLog` is a `FlightLog` with more methods.
"""


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown table; bars in cells are escaped."""
    lines = [head, ['---'] * len(head), *([cell.replace('|', '\\|') for cell in row]
                                          for row in rows)]
    return ''.join('| ' + ' | '.join(cell or ' ' for cell in line) + ' |\n' for line in lines)


def _number(value: float) -> str:
    return f'{value:.7g}'


def _value(value) -> str:
    """A parameter's value for a cell."""
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return ''
    if isinstance(value, (int, float, np.number)):
        return _number(value)
    if isinstance(value, (list, tuple, np.ndarray)):
        flat = list(value)
        if all(isinstance(one, (int, float, np.number)) for one in flat) and len(flat) <= 24:
            return '[' + ', '.join(_number(one) for one in flat) + ']'
        return 'see the file'
    if isinstance(value, dict):
        return 'see the file' if value else '{}'
    return f'`{value}`' if value != '' else '""'


def _range(meta) -> str:
    """Legal values of a declared number, or the choices."""
    if meta.get('choices'):
        return ', '.join(f'`{choice}`' for choice in meta['choices'])
    low, high = meta.get('low'), meta.get('high')
    if low is None and high is None:
        return ''
    if high is None:
        return f'at least {_number(low)}'
    return f'at most {_number(high)}' if low is None else f'{_number(low)} to {_number(high)}'


def _leaves(instance, prefix=''):
    """(dotted name, dataclass field, value) of each leaf, optional groups included."""
    for entry in fields(instance):
        value = getattr(instance, entry.name)
        if is_dataclass(value):
            yield from _leaves(value, f'{prefix}{entry.name}.')
        elif entry.init:
            yield prefix + entry.name, entry, value


def _load(name: str):
    """Shipped instance of a parameter file."""
    module, kind = FILES[name][0].split(':')
    kind = getattr(import_module(f'{PACKAGE}.{module}'), kind)
    return kind.load(str(ROOT / 'params' / name))


def parameters() -> str:
    """Every parameter of every shipped file."""
    text = [f'# Parameters\n\n{MADE}\n'
            'These are all values: the defaults of the code, with the changes of the files of '
            '`params/`.\nA value outside its range and an unknown key are refused. '
            'In ROS, `ros2 param describe` shows unit\nand range. '
            '[Nodes](nodes.md#parameters) lists which source overrides which.\n']
    seen: dict[str, str] = {}
    for name, (kind, what) in FILES.items():
        text.append(f'\n## {name}\n\n{what}\n\n')
        if name == 'robot.yaml':
            text.append(ROBOT_FILE)
        if kind in seen:
            same = {key: value for key, _, value in _leaves(_load(seen[kind]))}
            rows = [[f'`{key}`', _value(value) if repr(value) != '{}' else 'none',
                     _value(same.get(key))] for key, _, value in _leaves(_load(name))
                    if repr(value) != repr(same.get(key))]
            text.append(f'The keys are those of [{seen[kind]}](#{_anchor(seen[kind])}). These '
                        'values differ:\n\n'
                        + table(['key', 'value', f'in {seen[kind]}'], rows))
            continue
        seen[kind] = name
        rows = [[f'`{key}`', _value(value), entry.metadata.get('unit', ''),
                 _range(entry.metadata), entry.metadata.get('doc', '')]
                for key, entry, value in _leaves(_load(name))]
        text.append(table(['key', 'value', 'unit', 'range', 'meaning'], rows))
    return ''.join(text)


def _anchor(heading: str) -> str:
    return re.sub(r'[^\w\- ]', '', heading.lower()).strip().replace(' ', '-')


def _qos(qos) -> str:
    return ('reliable' if qos.reliable else 'best effort') + (
        ', latched' if qos.latched else f', depth {qos.depth}')


def topics() -> str:
    """Topics with types and quality of service."""
    known = {}
    for topic in TABLE:
        name = '<controller>/command' if controller_of(topic.name) else topic.name
        known.setdefault(name, (topic.type.replace('/msg/', '/'), _qos(topic.qos), topic.meaning))
    for name, (kind, profile, meaning) in OTHERS.items():
        known[name] = kind, _qos(getattr(message_topics, profile)), meaning
    return (f'# Topics\n\n{MADE}\n{CONVENTIONS}\n'
            + table(['topic', 'type', 'quality of service', 'meaning'],
                    [[f'`{topic}`', *row] for topic, row in known.items()]))


def command_line() -> str:
    """Every subcommand with its options."""
    from typer import Context
    from typer.cli import get_docs_for_click
    from typer.main import get_command

    from beetle_omni_ros.cli import app
    command = get_command(app)
    made = get_docs_for_click(obj=command, ctx=Context(command), name='beetle_omni')
    return f'# Command line\n\n{MADE}\n{STATUS}\n' + re.sub('^#', '##', made, flags=re.M)


def _wrapped(text: str) -> str:
    return fill(text, 98, break_long_words=False, break_on_hyphens=False)


def effects() -> str:
    """The catalogue of effects."""
    from beetle_omni_ros.identify.flights.treatment import TREATMENTS
    from beetle_omni_ros.model.effects import CATALOGUE, CONSUMERS, ignored
    from beetle_omni_ros.model.formula import SCALARS, TARGETS
    scalars = list(SCALARS)
    apart: dict[tuple, list] = {}
    for name in CATALOGUE:
        for key, consumer in CONSUMERS.items():
            if reason := ignored(key, name):
                apart.setdefault((consumer, reason), []).append(f'`{name}`')
    rows = [[f'`{name}`', f'`{key}`', spec.unit, _neutral(spec.neutral),
             '' if spec.text else f'{_number(spec.low)} to {_number(spec.high)}',
             'not fitted' if spec.form
             else _number(TREATMENTS[name].sizes[key].typical),
             '' if spec.form else _number(TREATMENTS[name].sizes[key].smallest),
             '' if spec.default is None else _neutral(spec.default),
             entry.settings.get(key) and f'`{entry.settings[key]}`' or '',
             'one for each term' if entry.each == 'term'
             else '4, one for each ' + entry.each if entry.each
             else '1, or 4 for each joint' if spec.of_each
             else str(len(spec.neutral)) if isinstance(spec.neutral, tuple) else '1']
            for name, entry in CATALOGUE.items()
            for key, spec in entry.parameters.items()]
    return (f'# Effects\n\n{MADE}\n'
            'An effect is a deviation of the robot from the model. The key `effects` of a robot '
            'file switches\neffects on, for example `effects: {thrust_coefficient: {scale: '
            '0.93}}`. [The gap\nfinder](../gap.md) searches the same entries. [Add an '
            'effect](../how-to/add_an_effect.md) shows how\nto add an entry.\n\n'
            + table(['effect', 'layer', 'equation, source', 'acts through', 'shows in',
                     'channels', 'confused with', 'separated by'],
                    [[f'`{name}`', entry.layer, entry.source, _acts(entry), fit.excited_by,
                      _channels(fit), ', '.join(f'`{other}`' for other in fit.confused_with),
                      fit.separated_by] for name, entry in CATALOGUE.items()
                     for fit in [TREATMENTS[name]]])
            + '\n## Parameters\n\n'
            '*Typical* is a realistic deviation from the neutral value. *Smallest* is the '
            'smallest relevant\ndeviation. If the neutral value is the number of the robot '
            'file, both are fractions of this number.\nA robot file may leave out a parameter '
            'that has a *default*.\n\n'
            + table(['effect', 'parameter', 'unit', 'neutral', 'range', 'typical', 'smallest',
                     'default', 'replaces', 'numbers'], rows)
            + '\n## Formula\n\n'
            + _wrapped('An expression of `formula` is TARGET: VECTOR * SCALAR * ..., a thrust has '
                       'no vector. ' + ' '.join(f'`{name}`: {", ".join(vectors)}.' for name, (
                           _, _, vectors, _) in TARGETS.items() if vectors)
                       + f' Scalars: {", ".join(scalars[:2])}; of rotors, which are summed, also '
                       + ', '.join(scalars[2:]) + '. Velocities are those of the hubs, thrusts '
                       'relative to hover, `ground` is (0.25 m / height)^2.') + '\n'
            + '\n## Consumers\n\n'
            + _wrapped(f'The consumers are {", ".join(CONSUMERS.values())}. Every effect acts in '
                       'each of them, except for these. `test/gap/test_consumers.py` tests every '
                       'pair.') + '\n\n'
            + table(['consumer', 'ignores', 'reason'],
                    [[who, ', '.join(names), reason]
                     for (who, reason), names in sorted(apart.items())]))


def _channels(fit) -> str:
    names = {'B': 'force and torque', 'J': 'joints', 'A': 'acceleration of the MoCap',
             'W': 'rate of turn of the MoCap'}
    return ', '.join(names[channel] for channel in fit.channels)


def _acts(entry) -> str:
    ways = {'body': 'the body equations', 'servo': 'the servo equation',
            'number': 'a number of the robot file', 'command': 'the delay of commands',
            'sensor': 'readings', 'feedback': 'readings of the encoders', 'play': 'play'}
    return ways[entry.kind]


def _neutral(value) -> str:
    values = set(value) if isinstance(value, tuple) else {value}
    one = values.pop()
    return f'`{one}`' if isinstance(one, str) else 'robot file' if one != one else _number(one)


def python() -> str:
    """The public module and the classes of its results."""
    import beetle_omni_ros as module
    from beetle_omni_ros.bags import log
    from beetle_omni_ros.control import base
    from beetle_omni_ros.show.report import NotebookLog
    text = [f'# Python\n\n{MADE}\n{TIMES}']
    for name in module.__all__:
        found = getattr(module, name)
        text.append(_documented(name, f'bo.{name}{_signature(found)}', found))
    for kind in (NotebookLog, log.FlightLog, log.Series, base.PoseTarget, base.TrajectoryTarget,
                 base.Reference):
        text.append(_documented(kind.__name__, kind.__name__, kind))
        if kind is NotebookLog:
            text += [_documented(name, f'log.{name}{_signature(getattr(kind, name))}',
                                 getattr(kind, name))
                     for name in ('metrics', 'plot', 'to_pandas', 'report')]
    return ''.join(text)


def _signature(function):
    return inspect.Signature([one.replace(annotation=inspect.Parameter.empty) for one in
                              inspect.signature(function).parameters.values()
                              if one.name != 'self'])


def _documented(name, call, documented):
    return f'\n## {name}\n\n```text\n{call}\n\n{inspect.getdoc(documented)}\n```\n'


PAGES = {'parameters.md': parameters, 'topics.md': topics, 'command_line.md': command_line,
         'effects.md': effects, 'python.md': python}
IN_FULL = 'effects.md', 'topics.md'     # the others change with each option and default


if __name__ == '__main__':
    if sys.argv[1:]:
        print(PAGES[f'{sys.argv[1]}.md'](), end='')
    else:
        for page in IN_FULL:
            (REFERENCE / page).write_text(PAGES[page](), encoding='utf-8')
