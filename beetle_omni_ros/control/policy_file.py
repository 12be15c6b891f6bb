"""
The metadata of a policy file, without torch and onnx.

A policy is only valid with the names, order, scales, rate and robot of its training. The metadata
contain all of these. The loader compares them with the inputs and outputs of this version, and
refuses a file that differs. See docs/reference/policy_file.md.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
import json
from math import isfinite

import numpy as np

from beetle_omni_ros.control.observation import Block, blocks, DISTURBANCES, size
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.robot.schema import ParameterError, quoted, shortened

FORMAT = 'beetle_omni_policy/1'
INPUT, OUTPUT = 'observation', 'action'
ACTIONS = JOINT_NAMES + ROTOR_NAMES
TILT_SCALE, THRUST_SCALE = 0.25, 0.5   # [rad], [N] for an action of 1, as published
RATE_HZ = 100.0
NAMED = 5                              # differing parameters in a message
LARGEST = 1e12                         # of a scale or an offset
TOLERANCE = 1e-6                       # of scales and offsets, which travel as text


def kind(memory: bool) -> str:
    """Name of a policy with or without the estimated disturbance."""
    return 'rl' + ('_memory' if memory else '')


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """
    Description of a policy: inputs, outputs, rate and robot.

    Attributes:
        observations: blocks of the input, in their order.
        actions: names of the outputs, in their order.
        action_scale: (8,) targets = scale * action + offset [rad, then N].
        action_offset: (8,) [rad, then N].
        rate_hz: steps a second.
        robot: name of the robot that it was trained for.
        robot_hash: :meth:`RobotParameters.hash` of that robot.
        robot_values: its parameters, :meth:`RobotParameters.as_dict`; {} in an old file.
        name: of the policy.
        training: conditions: randomisation, seed, iterations, duration and so on.
        metrics: results of the assessment.
        commit: of the code that trained it.
        version: of the package that wrote the file.
        created: ISO 8601.

    """

    observations: tuple[Block, ...]
    actions: tuple[str, ...] = ACTIONS
    action_scale: np.ndarray
    action_offset: np.ndarray
    rate_hz: float = RATE_HZ
    robot: str
    robot_hash: str
    robot_values: dict = field(default_factory=dict)
    name: str = ''
    training: dict = field(default_factory=dict)
    metrics: dict = field(default_factory=dict)
    commit: str = ''
    version: str = ''
    created: str = ''

    @classmethod
    def default(cls, robot: RobotParameters, memory: bool = False) -> PolicyContract:
        """Describe a policy that this version can fly on ``robot``."""
        return cls(observations=blocks(memory), robot=robot.name, robot_hash=robot.hash(),
                   robot_values=robot.as_dict(),
                   action_scale=np.repeat([TILT_SCALE, THRUST_SCALE], 4),
                   action_offset=np.repeat([0.0, robot.hover_thrust], 4),
                   name=kind(memory))

    @property
    def memory(self) -> bool:
        """Whether the estimated disturbance is an input."""
        return any(block.name == DISTURBANCES[0].name for block in self.observations)

    @property
    def observation_size(self) -> int:
        """Length of the input."""
        return size(self.observations)

    def to_metadata(self) -> dict[str, str]:
        """Texts for the ONNX file's custom metadata."""
        return {'format': FORMAT, 'name': self.name,
                'observations': json.dumps([asdict(block) for block in self.observations]),
                'actions': json.dumps(list(self.actions)),
                'action_scale': json.dumps(np.asarray(self.action_scale).tolist()),
                'action_offset': json.dumps(np.asarray(self.action_offset).tolist()),
                'rate_hz': f'{self.rate_hz:g}', 'robot': self.robot,
                'robot_hash': self.robot_hash,
                'robot_values': json.dumps(self.robot_values),
                'training': json.dumps(self.training), 'metrics': json.dumps(self.metrics),
                'commit': self.commit, 'version': self.version, 'created': self.created}

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> PolicyContract:
        """
        Read a file's custom metadata.

        Raises:
            ParameterError: naming the entry that is missing or unusable.

        """
        found = metadata.get('format')
        if found != FORMAT:
            raise ParameterError(f"metadata 'format': expected {FORMAT!r}, found {quoted(found)}")
        for key in ('robot', 'robot_hash'):
            if not metadata.get(key):
                raise ParameterError(f"metadata '{key}' is missing")
        texts = {key: metadata.get(key, '') for key in ('name', 'robot', 'robot_hash', 'commit',
                                                        'version', 'created')}
        return cls(observations=_blocks(metadata), actions=_names(metadata),
                   action_scale=_eight(metadata, 'action_scale'),
                   action_offset=_eight(metadata, 'action_offset'), rate_hz=_rate(metadata),
                   robot_values=_mapping(metadata, 'robot_values'),
                   training=_mapping(metadata, 'training'), metrics=_mapping(metadata, 'metrics'),
                   **texts)

    def check(self, robot: RobotParameters, allow_other_robot: bool = False) -> str:
        """
        Compare with the description of this version for ``robot``.

        Args:
            robot: the model of the robot.
            allow_other_robot: accept a policy that was trained for another one.

        Returns:
            A warning, one line, when another robot was allowed; else ''.

        Raises:
            ParameterError: naming the first thing that differs.

        """
        expected = PolicyContract.default(robot, self.memory)
        _check_blocks(self.observations, expected.observations)
        if self.actions != expected.actions:
            raise ParameterError(f"actions: expected the order {', '.join(expected.actions)}, "
                                 f"found {', '.join(self.actions)}")
        _check_numbers('action_scale', self.action_scale, expected.action_scale)
        if abs(self.rate_hz - expected.rate_hz) > TOLERANCE:
            raise ParameterError(f'rate_hz: expected {expected.rate_hz:g}, found '
                                 f'{self.rate_hz:g}')
        warning = self._other_robot(robot)
        if warning and not allow_other_robot:
            raise ParameterError(f'{warning}; train a policy for this robot, or fly this policy '
                                 'with --allow-other-robot (evaluate and fly; '
                                 'allow_other_robot:=true of launch file and nodes)')
        if not warning:
            _check_numbers('action_offset', self.action_offset, expected.action_offset)
        return warning

    def _other_robot(self, robot):
        """'' when trained for ``robot``, else what differs."""
        # Effects of sensors are corrected by the estimator and do not concern the policy.
        flown = replace(robot, effects={name: values for name, values in robot.effects.items()
                                        if CATALOGUE[name].kind != 'sensor'})
        if self.robot_hash == flown.hash():
            return ''
        known, shipped = self.robot_values, RobotParameters.load()
        if not known and shipped.hash() == self.robot_hash:
            known = shipped.as_dict()
        found = list(_differences(flown.as_dict(), known)) if known else []
        found = found or [f'robot_hash {self.robot_hash} in training, {flown.hash()} here']
        more = f'; {len(found) - NAMED} more' if len(found) > NAMED else ''
        return f"trained for other robot parameters: {'; '.join(found[:NAMED])}{more}"


def _differences(flown, trained, prefix=''):
    """Yield a text for each parameter of ``flown`` that differs in ``trained``."""
    for key, value in flown.items():
        other = trained.get(key) if isinstance(trained, dict) else None
        if isinstance(value, dict) and value and other:
            yield from _differences(value, other, f'{prefix}{key}.')
        elif value != other:
            yield (f'{prefix}{key} {shortened(str(other), 60)} in training, '
                   f'{shortened(str(value), 60)} here')


def _entry(metadata, key, kind, what):
    """JSON value of one entry, of the expected kind."""
    if key not in metadata:
        raise ParameterError(f"metadata '{key}' is missing")
    try:
        value = json.loads(metadata[key])
    except (RecursionError, ValueError):
        value = None
    if not isinstance(value, kind):
        raise ParameterError(f"metadata '{key}': expected {what}, found "
                             f'{_short(metadata[key])}')
    return value


def _blocks(metadata):
    what = 'a JSON list of blocks with name, size, unit and frame'
    table = _entry(metadata, 'observations', list, what)
    try:
        return tuple(Block(str(b['name']), int(b['size']), str(b['unit']), str(b['frame']))
                     for b in table)
    except (KeyError, OverflowError, TypeError, ValueError):
        raise ParameterError(f"metadata 'observations': expected {what}, found "
                             f"{_short(metadata['observations'])}") from None


def _names(metadata):
    return tuple(str(name) for name in _entry(metadata, 'actions', list, 'a JSON list of names'))


def _eight(metadata, key):
    what = f'a JSON list of {len(ACTIONS)} finite numbers'
    values = _entry(metadata, key, list, what)
    good = len(values) == len(ACTIONS) and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= LARGEST
        for v in values)
    if not good:
        raise ParameterError(f"metadata '{key}': expected {what}, found {_short(metadata[key])}")
    return np.array(values, dtype=float)


def _rate(metadata):
    try:
        rate = float(metadata['rate_hz'])
    except (KeyError, ValueError):
        rate = 0.0
    if not (isfinite(rate) and rate > 0):
        raise ParameterError("metadata 'rate_hz': expected a positive number, found "
                             f"{quoted(metadata.get('rate_hz'))}")
    return rate


def _mapping(metadata, key):
    return _entry(metadata, key, dict, 'a JSON object') if metadata.get(key) else {}


def _short(text):
    return repr(shortened(text, 60))


def _check_blocks(found, expected):
    if found == expected:
        return
    names = [block.name for block in found]
    if names != [block.name for block in expected]:
        raise ParameterError('observations: expected '
                             f"{', '.join(block.name for block in expected)}; found "
                             f"{', '.join(names) or 'none'}")
    ours, theirs = next((a, b) for a, b in zip(expected, found) if a != b)
    key = next(k for k in ('size', 'unit', 'frame') if getattr(ours, k) != getattr(theirs, k))
    raise ParameterError(f'observations: {key} of {ours.name}: expected '
                         f'{getattr(ours, key)!r}, found {getattr(theirs, key)!r}')


def _check_numbers(key, found, expected):
    for name, ours, theirs in zip(ACTIONS, expected, found):
        if abs(ours - theirs) > TOLERANCE * max(1.0, abs(ours)):
            raise ParameterError(f'{key} of {name}: expected {ours:g}, found {theirs:g}')
