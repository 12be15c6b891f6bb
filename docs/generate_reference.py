"""
Write the pages of docs/reference that are made from code: ``python docs/generate_reference.py``.

| page | made from |
| --- | --- |
| parameters.md | the dataclasses that read params/*.yaml, and the values in these files |
| topics.md | messages/topics.py, and the publishers and subscribers in nodes/*.py |
| command_line.md | the options of ``beetle_omni`` and its subcommands |
| effects.md | the catalogue of effects |
| python.md | the docstrings of the public module and of a flight's arrays |

``--check`` writes nothing and exits with status 1 where a page is out of date. ROS is not needed:
the files of the nodes are read, not imported.
"""

from __future__ import annotations

import ast
from dataclasses import fields, is_dataclass
from importlib import import_module
import inspect
from pathlib import Path
import re
import sys

import numpy as np

from beetle_omni_ros.messages import topics as message_topics
from beetle_omni_ros.messages.topics import controller_of, TABLE
from beetle_omni_ros.robot.resources import PACKAGE

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / 'docs' / 'reference'
MADE = '<!-- Made by docs/generate_reference.py; changes by hand are lost. -->\n'

# Parameter file -> class that reads it, what it holds.
FILES = {
    'robot.yaml': ('robot.parameters:RobotParameters', 'The robot.'),
    'robot_measured.yaml': ('robot.parameters:RobotParameters',
                            'The robot as measured logs show it.'),
    'robot_weak_and_heavy.yaml': ('robot.parameters:RobotParameters',
                                  'A robot with less thrust and more mass than in robot.yaml.'),
    'nmpc.yaml': ('control.nmpc_parameters:NmpcParameters', 'The NMPC.'),
    'nmpc_published.yaml': ('control.nmpc_parameters:NmpcParameters',
                            'The NMPC with the settings of the publication.'),
    'rl.yaml': ('control.policy:PolicyParameters', 'The policy and its guidance.'),
    'hover.yaml': ('control.hover:HoverParameters', 'The hover controller.'),
    'degraded.yaml': ('robot.degraded:HoldingParameters',
                      'Attitudes that can be held with a failed actuator.'),
    'ekf.yaml': ('estimation.parameters:EkfParameters', 'The estimator.'),
    'supervisor.yaml': ('safety.parameters:SupervisorParameters',
                        'Checks of commands, takeoff, landing, detection of faults.'),
    'targets.yaml': ('runs.targets:TargetLimits', 'What a target pose must keep to.'),
    'drive.yaml': ('drive:DriveParameters', 'Driving by hand.'),
    'servo_bus.yaml': ('drivers.device_parameters:ServoBusParameters', 'The bus of tilt servos.'),
    'motor_board.yaml': ('drivers.device_parameters:MotorBoardParameters',
                         'The motor board.'),
    'emulated_board.yaml': ('sim.emulated.motor_board:EmulatedBoardParameters',
                            'The emulated motor board.'),
    'simulator.yaml': ('sim.parameters:SimulatorParameters', 'The simulated world.'),
    'recording.yaml': ('identify.recording.limits:RecordingLimits',
                       'Limits of the checks of a recording against itself.'),
    'train.yaml': ('train.parameters:TrainParameters', 'The training of a policy.'),
    'faults.yaml': ('sim.fault_lists:FaultList', 'The listed faults.'),
    'identify.yaml': ('identify.parameters:IdentifyParameters',
                      'Identification of servos and rotors from logs.'),
    'gap.yaml': ('identify.gap.parameters:GapParameters', 'The gap finder.')}

ROBOT_FILE = """`mass`, `inertia` and `rotors.positions` are authoritative. With `multibody`, the
simulated main body is what modules and end-effector leave of them. `multibody.main_body`,
`multibody.module.joint_offset` and `multibody.centre_of_gravity_height` follow from these numbers.
They are optional checks. A file that contradicts itself by more than 0.5 mm is refused, or if
`multibody.main_body.inertia` is larger than the rest or lacks more than 10 % of the total inertia.

A file that extends another moves what depends on its numbers:

- If mass, rotor positions or parts change and the file has no `inertia`, the inertia follows. The
  main body keeps its radii of gyration. Without `multibody`, changed positions need the `inertia`
  beside them.
- The checks of the extended file apply only if the file repeats them.

"""

# Classes of nodes/ whose calls count for other nodes; '' for none.
SHARED = {'ControllerNode': 'nmpc_node, rl_node', 'Health': 'every node',
          'RecorderNode': ''}

# Topics that viewers and clocks need, which no other part of the package reads.
OTHERS = {
    '/clock': ('rosgraph_msgs/Clock', 'SENSOR', 'simulated time, with `--clock simulated`'),
    '/tf': ('tf2_msgs/TFMessage', 'EVENT', 'moving frames: `world`, `base_link`, each '
            'tilting module; 50 Hz, in each bag'),
    '/tf_static': ('tf2_msgs/TFMessage', 'LATCHED',
                   'fixed frames: rotors, main body, end effector, IMU'),
    'robot_description': ('std_msgs/String', 'LATCHED', 'URDF for viewers'),
    'markers': ('visualization_msgs/MarkerArray', 'EVENT', 'targets and thrusts for viewers')}


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
        if name == 'faults.yaml':
            text.append('[Safety](../safety.md#every-fault-of-the-list) lists the faults.\n\n')
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


def _topic(value, constants) -> list[str]:
    """Topic names of an argument: text, a constant, or text with the name of a part in it."""
    if isinstance(value, ast.Constant):
        return [value.value]
    if isinstance(value, ast.Name):
        return constants.get(value.id, [])
    if isinstance(value, ast.JoinedStr):
        end = ''.join(part.value for part in value.values if isinstance(part, ast.Constant))
        return ['joint_bridge/state', 'rotor_bridge/state'] if end.endswith('bridge/state') \
            else [f'<controller>{end}']
    return []


def _constants(tree: ast.AST) -> dict[str, list[str]]:
    """Names of a file that stand for topics: constants, and what a loop runs over."""
    found = {}
    for item in ast.walk(tree):
        if isinstance(item, ast.Assign) and isinstance(item.targets[0], ast.Name):
            found[item.targets[0].id] = _topic(item.value, {})
        elif isinstance(item, ast.For) and isinstance(item.target, ast.Name) \
                and isinstance(item.iter, ast.Tuple):
            found[item.target.id] = [name for one in item.iter.elts for name in _topic(one, {})]
    return found


def _ends() -> dict[str, dict[str, list[str]]]:
    """Topic -> its publishers and its subscribers, from the files of the nodes."""
    found: dict[str, dict[str, list[str]]] = {}
    nodes = ROOT / PACKAGE / 'nodes'
    shared = _constants(ast.parse((nodes / 'node.py').read_text(encoding='utf-8')))
    ways = {'publisher': ('from', 0), 'Publisher': ('from', 1), 'create_publisher': ('from', 1),
            'listen': ('to', 0), 'follow': ('to', 0)}
    for path in sorted((*nodes.glob('*_node.py'), *nodes.glob('*_nodes.py'), nodes / 'node.py')):
        tree = ast.parse(path.read_text(encoding='utf-8'))
        constants = {**shared, **_constants(tree)}
        for kind in (item for item in tree.body if isinstance(item, ast.ClassDef)):
            name = re.sub(r'(?<=[a-z])(?=[A-Z])', '_', kind.name).lower()
            node = SHARED.get(kind.name, name if name.endswith('_node') else '')
            for call in ast.walk(kind):
                if not node or not isinstance(call, ast.Call) \
                        or not isinstance(call.func, ast.Attribute) or call.func.attr not in ways:
                    continue
                way, place = ways[call.func.attr]
                given = call.args[place] if len(call.args) > place else None
                for topic in _topic(given, constants):
                    entry = found.setdefault(topic, {'from': [], 'to': []})
                    entry[way] += [one for one in node.split(', ') if one not in entry[way]]
    # Read through the class that checks the publisher.
    found['supervisor/identity']['to'] = list(found['command']['to'])
    found['/tf']['from'].append('robot_state_publisher')
    for topic in ('/tf_static', 'robot_description'):
        found[topic] = {'from': ['robot_state_publisher'], 'to': []}
    return found


def _qos(qos) -> str:
    return ('reliable' if qos.reliable else 'best effort') + (
        ', latched' if qos.latched else f', depth {qos.depth}')


def topics() -> str:
    """Topics with types, quality of service, publishers and subscribers."""
    known = {}
    for topic in TABLE:
        name = '<controller>/command' if controller_of(topic.name) else topic.name
        known.setdefault(name, (topic.type.replace('/msg/', '/'), _qos(topic.qos), topic.meaning))
    for name, (kind, profile, meaning) in OTHERS.items():
        known[name] = kind, _qos(getattr(message_topics, profile)), meaning
    nodes = _ends()
    missing = sorted(set(nodes) ^ set(known))
    if missing:
        raise SystemExit(f'the table of topics and the nodes differ in {", ".join(missing)}')
    said = [[f'`{topic}`', kind, meaning] for topic, (kind, _, meaning) in known.items()]
    ends = [[f'`{topic}`', *(', '.join(f'`{node}`' if node != 'every node' else node
                                       for node in nodes[topic][way]) for way in ('from', 'to')),
             qos if nodes[topic]['from'] else ''] for topic, (_, qos, _) in known.items()]
    return (f'# Topics\n\n{MADE}\n'
            'Names are relative; a launch argument sets a namespace. On the robot, the drivers of '
            'MoCap and IMU\npublish `mocap/pose` and `imu/data_raw` in place of `sim_node`. '
            '`recorder_node` subscribes to every\ntopic of a bag except the frames, which it '
            'computes from `odom` and `joint_states`.\n\n'
            + table(['topic', 'type', 'meaning'], said)
            + '\n## Publishers and subscribers\n\n'
            + table(['topic', 'published by', 'subscribed by', 'quality of service'], ends)
            + '\n## Frames and conventions\n\n'
            '- Units are SI, angles are radians, times are seconds.\n'
            '- Axes follow REP-103: x forward, y left, z up. `world` is the frame of the MoCap, '
            'with z up.\n'
            '- `base_link` is at the centre of gravity.\n'
            '- Quaternions are (x, y, z, w).\n'
            '- A command is one `sensor_msgs/JointState` with `name = [gimbal1..4, rotor1..4]`. '
            '`position` holds\n  the four tilt targets [rad], then four NaN. `effort` holds four '
            'NaN, then the four thrust targets\n  [N]. `velocity` is empty.\n'
            '- The stamp of a command is the time of the state estimate from which it was '
            'computed.\n')


def _options(command) -> list[list[str]]:
    rows = []
    for option in command.params:
        if 'help' in option.opts or '--help' in option.opts:
            continue
        names = '/'.join([', '.join(option.opts), *option.secondary_opts])
        if option.param_type_name == 'argument':
            names = (option.metavar or option.name.upper()) + ('...' if option.nargs != 1
                                                               and not (option.metavar or '')
                                                               .rstrip(']').endswith('...')
                                                               else '')
        is_flag = getattr(option, 'is_flag', False)     # an argument has none
        if option.param_type_name != 'argument' and not is_flag:
            names += f' {option.metavar or option.name.upper()}'
        default = option.default
        text = 'required' if option.required else ''
        has_default = default is not None and str(default) not in ('', 'False', '()')
        if not option.required and has_default and not callable(default) \
                and not (is_flag and not option.secondary_opts):
            text = (option.opts[0] if default else option.secondary_opts[0]) \
                if is_flag else str(default)
        rows.append([f'`{names}`', f'`{text}`' if text not in ('', 'required') else text,
                     ' '.join((getattr(option, 'help', '') or '').split())])
    return rows


def _commands(command, name):
    if hasattr(command, 'commands'):
        for part, inner in command.commands.items():
            yield from _commands(inner, f'{name} {part}')
    else:
        yield name, command


def command_line() -> str:
    """Every subcommand with its options."""
    from typer.main import get_command

    from beetle_omni_ros.cli import app
    text = [f'# Command line\n\n{MADE}\n'
            '`beetle_omni` is also `ros2 run beetle_omni_ros beetle_omni`. Each subcommand has '
            '`--help`.\n\n'
            + table(['exit status', 'meaning'], [
                ['0', 'success'], ['1', 'a flight failed or crashed, or a check failed'],
                ['2', 'unusable input; one line on standard error'],
                ['3', '`gap`: the verdict `bad_data`'], ['130', 'interrupted']])]
    for name, command in _commands(get_command(app), 'beetle_omni'):
        description = (command.help or '').replace('\b', '').strip()
        paragraphs = [' '.join(part.split()) for part in description.split('\n\n')]
        text.append(f'\n## {name}\n')
        for paragraph in paragraphs:
            sentences, _, example = paragraph.partition('Example: ')
            text += [f'\n{_wrapped(sentences.strip())}\n'] if sentences.strip() else []
            text += [f'\n```sh\n{example.strip()}\n```\n'] if example else []
        text.append('\n' + table(['option', 'default', 'meaning'], _options(command)))
    return ''.join(text)


def _wrapped(text: str) -> str:
    from textwrap import fill
    return fill(text, 98, break_long_words=False, break_on_hyphens=False)


def effects() -> str:
    """The catalogue of effects."""
    from beetle_omni_ros.robot.effects import CATALOGUE, CONSUMERS, treatment
    apart: dict[tuple, list] = {}
    for name in CATALOGUE:
        for key, consumer in CONSUMERS.items():
            if not (found := treatment(key, name)).acts:
                apart.setdefault((consumer, found.reason), []).append(f'`{name}`')
    rows = [[f'`{name}`', f'`{key}`', spec.unit, _neutral(spec.neutral),
             f'{_number(spec.low)} to {_number(spec.high)}', 'not fitted' if spec.form
             else _known(spec.typical), _known(spec.smallest),
             '' if spec.default is None else _neutral(spec.default),
             entry.settings.get(key) and f'`{entry.settings[key]}`' or '',
             '4, one for each ' + entry.each if entry.each
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
                    [[f'`{name}`', entry.layer, entry.source, _acts(entry), entry.excited_by,
                      _channels(entry), ', '.join(f'`{other}`' for other in entry.confused_with),
                      entry.separated_by] for name, entry in CATALOGUE.items()])
            + '\n## Parameters\n\n'
            '*Typical* is a realistic deviation from the neutral value. *Smallest* is the '
            'smallest relevant\ndeviation. If the neutral value is the number of the robot '
            'file, both are fractions of this number.\nA robot file may leave out a parameter '
            'that has a *default*.\n\n'
            + table(['effect', 'parameter', 'unit', 'neutral', 'range', 'typical', 'smallest',
                     'default', 'replaces', 'numbers'], rows)
            + '\n## Consumers\n\n'
            + _wrapped(f'The consumers are {", ".join(CONSUMERS.values())}. Every effect acts in '
                       'each of them, except for these. `test/gap/test_consumers.py` tests every '
                       'pair.') + '\n\n'
            + table(['consumer', 'ignores', 'reason'],
                    [[who, ', '.join(names), reason]
                     for (who, reason), names in sorted(apart.items())]))


def _channels(entry) -> str:
    names = {'B': 'force and torque', 'J': 'joints', 'A': 'acceleration of the MoCap',
             'W': 'rate of turn of the MoCap'}
    return ', '.join(names[channel] for channel in entry.channels)


def _acts(entry) -> str:
    ways = {'body': 'the body equations', 'servo': 'the servo equation',
            'number': 'a number of the robot file', 'command': 'the delay of commands',
            'sensor': 'readings', 'feedback': 'readings of the encoders', 'play': 'play'}
    both = ' and the servo equation' if entry.kind == 'body' and entry.servo else ''
    return ways[entry.kind] + both


def _neutral(value) -> str:
    values = set(value) if isinstance(value, tuple) else {value}
    one = values.pop()
    return 'robot file' if one != one else _number(one)


def _known(value) -> str:
    return '' if value != value else _number(value)


def python() -> str:
    """The public module and the classes of its results."""
    import beetle_omni_ros as module
    from beetle_omni_ros.control import base
    from beetle_omni_ros.runs import log
    text = [f'# Python\n\n{MADE}\n'
            'The functions of `import beetle_omni_ros as bo`. They need no ROS. Short scripts are '
            'in\n`examples/`; `examples/read_bag.py` reads a bag.\n\n'
            + table(['function', ''], [
                [f'[`bo.{name}`](#{name})', _sections(_documented(module, name))['']
                 .partition('\n\n')[0]] for name in module.__all__])]
    for name in module.__all__:
        function = _documented(module, name)
        parameters = [one.replace(annotation=inspect.Parameter.empty) for one in
                      inspect.signature(function).parameters.values() if one.name != 'self']
        call = f'bo.{name}{inspect.Signature(parameters)}'
        text.append(f'\n## {name}\n\n```python\n{call}\n```\n{_described(function)}')
    text.append(
        '\n## Times of a flight\n\nThe times of a recorded flight (`bo.read_run`) are absolute, '
        'in seconds since 1970-01-01 UTC. Those\nof `bo.simulate` begin at 0. `log.imu_t - '
        'log.start` is the time since the start of either. The\ntimes of a `TrajectoryTarget`, '
        'and the argument of `target.at(t)`, are on the same clock.\n')
    for kind in (log.FlightLog, log.Commands, base.PoseTarget, base.TrajectoryTarget,
                 base.Reference):
        text.append(f'\n## {kind.__name__}\n{_described(kind)}')
        methods = [[f'`{name}`' if isinstance(one, property) else f'`{name}()`',
                    ' '.join(_sections(one)[''].split())]
                   for name, one in vars(kind).items() if not name.startswith('_')
                   and (isinstance(one, property) or inspect.isfunction(one))]
        text.append('\n' + table(['property, method', ''], methods) if methods else '')
    return ''.join(text)


def _documented(module, name):
    """A public function; `robot` is a subpackage that can be called."""
    found = getattr(module, name)
    return found if inspect.isfunction(found) else type(found).__call__


def _described(documented) -> str:
    """A docstring as Markdown: text, a table of arguments or fields, results, errors."""
    sections = _sections(documented)
    parts = [_wrapped(' '.join(part.split())) for part in sections.pop('').split('\n\n')]
    for title, content in sections.items():
        if title in ('Args', 'Attributes'):
            entries = re.findall(r'^(\w[^:\n]*):\s+(.*(?:\n +.*)*)', content, flags=re.M)
            parts.append(table(['argument' if title == 'Args' else 'field', ''], [
                [', '.join(f'`{name}`' for name in names.split(', ')), ' '.join(what.split())]
                for names, what in entries]).rstrip())
        else:
            parts.append(_wrapped(f'*{title}*: ' + ' '.join(content.split())))
    return ''.join(f'\n{part}\n' for part in parts)


def _sections(documented) -> dict[str, str]:
    """Title -> content of a docstring of Google style; '': the text before."""
    text = re.sub(r':\w+:`~?([^`]*)`', r'`\1`', inspect.getdoc(documented)).replace('``', '`')
    parts = re.split(r'^(Args|Attributes|Returns|Raises):\n', text, flags=re.M)
    return {'': parts[0].strip(), **{title: inspect.cleandoc(content) for title, content
                                     in zip(parts[1::2], parts[2::2], strict=True)}}


PAGES = {'parameters.md': parameters, 'topics.md': topics, 'command_line.md': command_line,
         'effects.md': effects, 'python.md': python}


def out_of_date() -> list[str]:
    """Names of pages that differ from those made from the code."""
    return [name for name, make in PAGES.items() if not (REFERENCE / name).is_file()
            or (REFERENCE / name).read_text(encoding='utf-8') != make()]


def main(arguments: list[str]) -> int:
    """Write the pages, or check them; returns the exit status."""
    if '--check' in arguments:
        old = out_of_date()
        for name in old:
            print(f'docs/reference/{name} is out of date: python docs/generate_reference.py')
        return bool(old)
    REFERENCE.mkdir(exist_ok=True)
    for name, make in PAGES.items():
        (REFERENCE / name).write_text(make(), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
