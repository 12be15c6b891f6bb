"""
A policy file: its contract, its checksum and its network; read without torch and onnx.

A policy is only valid with the names, order, scales, rate and robot of its training, which are in
its metadata. With a flipped bit in a weight the file still loads; the checksum therefore covers
every byte of the file except its own entry. See docs/reference/policy_file.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import zip_longest
import json
import logging
from math import isfinite
import os
from pathlib import Path
import sys
from typing import Any

import numpy as np

from beetle_omni_ros.model.effects import CATALOGUE, ignored
from beetle_omni_ros.model.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES, value_of
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import nest, ParameterError, quoted, shortened

log = logging.getLogger(__name__)
FORMAT = 'beetle_omni_policy/1'
INPUT, OUTPUT = 'observation', 'action'
TILT_SCALE, THRUST_SCALE = 0.25, 0.5   # [rad], [N] for an action of 1, as published
RATE_HZ = 100
LONGEST = 500           # characters of differences in a message: metadata may hold anything
WARM_UP = 20            # calls at start, because the first calls are slow
FATAL_ONLY = 4          # onnxruntime's log level: errors are raised, and reported by this module
# The checksum as ONNX's protobuf stores it; DIGITS hexadecimal digits follow.
ENTRY, DIGITS = b'rS\n\x08checksum\x12Gsha256:', 64

# What a policy is trained for: the values of a robot file that the training environment uses.
# With other names, or other keys in a file, the version increases.
TRAINED_FOR_VERSION = 1
TRAINED_FOR = (
    'mass', 'gravity', 'inertia', *(f'rotors.{name}' for name in (
        'positions', 'arm_yaw', 'spin', 'torque_to_thrust_ratio', 'thrust_min', 'thrust_max',
        'time_constant')),
    *(f'joints.{name}' for name in (
        'inertia', 'kp', 'kd', 'velocity_limit', 'effort_limit', 'position_limit')),
    *(f'multibody.module.{name}' for name in ('mass', 'centre_of_mass', 'inertia')), 'effects')

# Blocks of the observation: SI unit ('1': none), and what the values belong to; the last two are
# those of a policy with memory.
OBSERVATIONS = [dict(zip(('name', 'size', 'unit', 'frame'), row)) for row in (
    ('velocity', 3, 'm/s', 'base_link'),                 # R^T (v - v_ref)
    ('angular_velocity', 3, 'rad/s', 'base_link'),       # w - R^T R_ref w_ref
    ('target_position', 3, 'm', 'base_link'),            # R^T (p_ref - p)
    ('attitude', 6, '1', 'world'),                       # x and z axis of base_link
    ('target_attitude', 6, '1', 'world'),                # x and z axis of the reference
    ('tilt', 4, 'rad', 'joint'),                         # measured
    ('previous_action', 8, '1', 'action'),               # the command in force
    ('disturbance_force', 3, 'N', 'base_link'),          # estimated external force
    ('disturbance_torque', 3, 'N m', 'base_link'))]      # estimated external torque
# Entries of the metadata in JSON; the others are plain text. A file need not have the last two.
JSON = ('observations', 'actions', 'action_scale', 'action_offset', 'rate_hz', 'robot_values',
        'training')


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Description of a policy: the metadata of docs/reference/policy_file.md."""

    observations: list[dict]        # blocks of the input, in their order
    actions: list[str]              # names of the outputs, in their order
    action_scale: list[float]       # targets = scale * action + offset [rad, then N]
    action_offset: list[float]
    rate_hz: float
    robot: str
    robot_hash: str                 # :func:`robot_hash` of the values
    robot_values: dict              # :func:`trained_for`
    name: str
    training: dict = field(default_factory=dict)
    commit: str = ''
    version: str = ''
    created: str = ''

    @classmethod
    def default(cls, robot: RobotParameters, memory: bool = False) -> PolicyContract:
        """Describe a policy that this version can fly on ``robot``."""
        return cls(observations=OBSERVATIONS if memory else OBSERVATIONS[:-2],
                   actions=[*JOINT_NAMES, *ROTOR_NAMES],
                   action_scale=[TILT_SCALE] * 4 + [THRUST_SCALE] * 4,
                   action_offset=[0.0] * 4 + [robot.hover_thrust] * 4, rate_hz=RATE_HZ,
                   robot=robot.name, robot_hash=robot_hash(robot), robot_values=trained_for(robot),
                   name='rl_any' if memory else 'rl')

    @property
    def memory(self) -> bool:
        """Whether the estimated disturbance is an input."""
        return len(self.observations) == len(OBSERVATIONS)

    @property
    def observation_size(self) -> int:
        """Length of the input."""
        return sum(block['size'] for block in self.observations)

    def to_metadata(self) -> dict[str, str]:
        """Texts for the ONNX file's custom metadata."""
        return {'format': FORMAT, **{key: json.dumps(value) if key in JSON else value
                                     for key, value in vars(self).items()}}

    @classmethod
    def from_metadata(cls, metadata: dict[str, str]) -> PolicyContract:
        """Read a file's custom metadata; an error names the missing or unusable entry."""
        found = metadata.get('format')
        if found != FORMAT:
            raise ParameterError(f"metadata 'format': expected {FORMAT!r}, found {quoted(found)}")
        values: dict[str, Any] = {}
        for key in cls.__dataclass_fields__:
            text = metadata.get(key, '{}' if key in JSON[-2:] else '')
            try:
                values[key] = json.loads(text) if key in JSON else text
            except (RecursionError, ValueError):
                raise ParameterError(f"metadata '{key}': missing or unusable, found "
                                     f'{quoted(text)}') from None
        if ':' not in values['robot_hash'] and values['robot_values']:
            # a file of an earlier version, whose hash covered every value of the robot file
            values['robot_hash'] = robot_hash(values['robot_values'])
        return cls(**values)

    def trained_robot(self, robot: RobotParameters) -> RobotParameters:
        """``robot`` with the values for which the policy is trained, but for its modules."""
        if self.robot_hash == robot_hash(robot):
            return robot
        if not self.robot_values:
            raise ParameterError("metadata 'robot_values': missing, expected the values of the "
                                 'robot of the training')
        values = trained_for(self.robot_values)
        parts = {part: replace(getattr(robot, part), **_arrays(values[part]))
                 for part in ('rotors', 'joints')}
        return replace(robot, **parts, effects=values['effects'], **_arrays(
            {name: values[name] for name in ('mass', 'gravity', 'inertia')}))

    def check(self, robot: RobotParameters) -> str:
        """
        Compare with this version for ``robot``; ParameterError names the first difference.

        Returns:
            The differences from the robot of the training, one line; '' without any.

        """
        expected, other = PolicyContract.default(robot, self.memory), ''
        if self.robot_hash != expected.robot_hash:
            found = list(_differences(expected.robot_values, trained_for(self.robot_values))) or [
                f'robot_hash {self.robot_hash} in training, {expected.robot_hash} here']
            other = f"trained for other robot parameters: {shortened('; '.join(found), LONGEST)}"
        for key in ('observations', 'actions', 'action_scale', 'rate_hz',
                    *([] if other else ['action_offset'])):
            ours, theirs = getattr(expected, key), getattr(self, key)
            if isinstance(ours, list) and isinstance(theirs, list):     # the first that differs
                ours, theirs = next((pair for pair in zip_longest(ours, theirs)
                                     if pair[0] != pair[1]), (None, None))
            if ours != theirs:
                raise ParameterError(f'{key}: expected {ours}, found {theirs}')
        if other:
            self.trained_robot(robot)
        return other


def trained_for(robot: RobotParameters | dict) -> dict:
    """
    Values of ``TRAINED_FOR``, nested, of a robot or of the ``robot_values`` of a file.

    Effects that the training leaves out, as those that the estimator corrects, are no part of it.
    """
    values = {key: value_of(robot, key) for key in TRAINED_FOR}
    values['effects'] = {name: each for name, each in (values['effects'] or {}).items()
                         if name not in CATALOGUE or not ignored('training', name)}
    return _plain(nest(values))


def robot_hash(robot: RobotParameters | dict) -> str:
    """Version and digest of what a policy is trained for, by name."""
    text = json.dumps(trained_for(robot), sort_keys=True)
    return f'{TRAINED_FOR_VERSION}:{sha256(text.encode()).hexdigest()[:16]}'


def _plain(value):
    """Nested mapping with floats, lists of floats and lists of text."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    array = np.asarray(value)
    return value if value is None else (
        array if array.dtype.kind == 'U' else array.astype(float)).tolist()


def _arrays(values):
    """``values`` with arrays for lists."""
    return {key: np.array(value) if isinstance(value, list) else value
            for key, value in values.items()}


def _differences(flown, trained, prefix=''):
    """Yield a text for each parameter of ``flown`` that differs in ``trained``."""
    for key, value in flown.items():
        other = trained.get(key) if isinstance(trained, dict) else None
        if isinstance(value, dict) and value and other:
            yield from _differences(value, other, f'{prefix}{key}.')
        elif value != other:
            yield (f'{prefix}{key} {shortened(str(other), 60)} in training, '
                   f'{shortened(str(value), 60)} here')


def verify(data: bytes) -> None:
    """Compare an ONNX file's content with the checksum in it; refuse it if they differ."""
    before, entry, after = data.rpartition(ENTRY)
    if not entry:
        raise ParameterError("metadata 'checksum' is missing: truncated, or no policy; python -m "
                             'beetle_omni_ros.control.policy_file FILE adds it to a policy that '
                             'you trust')
    if after[:DIGITS] != sha256(before + after[DIGITS:]).hexdigest().encode():
        raise ParameterError('weights, graph or metadata are not those that were exported: their '
                             "checksum differs from the metadata's 'checksum'; take an undamaged "
                             'copy')


def add_checksum(path: str | Path) -> None:
    """Write the checksum into a file, in place of an older one; the rest is unchanged."""
    path = Path(path)
    data = path.read_bytes()
    before, entry, after = data.rpartition(ENTRY)
    if entry:
        data = before + after[DIGITS:]
    part = path.with_name(f'{path.name}.part')
    part.write_bytes(data + ENTRY + sha256(data).hexdigest().encode())
    part.replace(path)


def session(data: bytes):
    """Open an ONNX file's content with onnxruntime: one thread, without spinning."""
    # From version 1.29 on it starts threads and sends reports unless this is set.
    os.environ.setdefault('ORT_DISABLE_TELEMETRY', '1')
    import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    options.enable_cpu_mem_arena = False    # an inference needs one small block
    options.log_severity_level = FATAL_ONLY
    return onnxruntime.InferenceSession(data, options, providers=['CPUExecutionProvider'])


class PolicyNetwork:
    """
    One policy, on the calling thread alone, with fixed buffers for input and output.

    Raises:
        ParameterError: one line with the file and what is missing, broken or different.

    """

    def __init__(self, path: str | Path, robot: RobotParameters):
        path = find(path)
        try:
            other = self._open(path.read_bytes(), robot)
        except ParameterError as error:
            raise ParameterError(f'policy {path}: {shortened(str(error), 2 * LONGEST)}') from None
        except Exception as error:      # onnxruntime's exceptions have no common base class
            # the informative end of its messages, which begin with codes
            reason = str(error).strip().partition('\n')[0].split(' : ')[-1]
            raise ParameterError(f'policy {path}: not a usable ONNX file '
                                 f'({shortened(reason)})') from None
        if other:
            log.info('policy %s: %s', path, other)

    def __call__(self, observation: list[float]) -> list[float]:
        """Action (8) for an observation (n), both in plain numbers."""
        self._input[0] = observation
        self._session.run_with_iobinding(self._binding)
        return self._output[0].tolist()

    def _open(self, data, robot):
        """Check contract and tensors, let the session use two arrays at every call, warm up."""
        verify(data)
        network = self._session = session(data)
        self.contract = PolicyContract.from_metadata(network.get_modelmeta().custom_metadata_map)
        other = self.contract.check(robot)
        size = self.contract.observation_size
        self._input = np.zeros((1, size), np.float32)
        self._output = np.zeros((1, len(self.contract.actions)), np.float32)
        binding = self._binding = network.io_binding()
        for name, bind, array, found in (
                (INPUT, binding.bind_input, self._input, network.get_inputs()),
                (OUTPUT, binding.bind_output, self._output, network.get_outputs())):
            tensors = [(tensor.name, tensor.type, *tensor.shape[1:]) for tensor in found]
            expected = [(name, 'tensor(float)', array.shape[1])]
            if tensors != expected:
                raise ParameterError(f'expected {expected}, found {tensors}')
            bind(name, 'cpu', 0, np.float32, array.shape, array.ctypes.data)
        for _ in range(WARM_UP):
            action = self([0.1] * size)
        if not all(map(isfinite, action)):
            raise ParameterError('the action for an observation of 0.1 is not finite')
        return other


def find(path: str | Path) -> Path:
    """Locate a policy: an absolute path, or one in the package's share or the present folder."""
    try:
        found = share_path(str(path))
    except FileNotFoundError:
        found = Path(path)
    if not found.is_file():
        raise ParameterError(f"policy {path}: no such file, neither in the package's share nor in "
                             f'{Path.cwd()}')
    return found


if __name__ == '__main__':
    for name in sys.argv[1:]:
        add_checksum(name)
