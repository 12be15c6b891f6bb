"""A policy file as a function: loaded, checked and warmed up."""

import logging
from math import isfinite
from pathlib import Path

import numpy as np

from beetle_omni_ros.control import onnx_runtime, policy_checksum
from beetle_omni_ros.control.policy_file import ACTIONS, INPUT, OUTPUT, PolicyContract
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError, shortened

onnxruntime = onnx_runtime.load()
log = logging.getLogger(__name__)
WARM_UP = 20            # calls at start, because the first calls are slow
LONGEST = 1000          # characters of a refusal: the metadata may hold anything
LARGEST = 1 << 28       # bytes of a file; the shipped ones have 0.8 MB
FATAL_ONLY = 4          # onnxruntime's log level: errors are raised, and reported by this module
LEVEL = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0)   # x and z axis of a level body


class PolicyNetwork:
    """
    One policy, ready to be called.

    Runs on the calling thread alone, with fixed buffers for input and output.

    Args:
        path: ONNX file with the metadata of :class:`PolicyContract`.
        robot: the robot that it flies.
        allow_other_robot: accept one that was trained for other robot parameters.

    Attributes:
        contract: the metadata of the file.

    Raises:
        ParameterError: one line with the file and what is missing, broken or different.

    """

    def __init__(self, path: str | Path, robot: RobotParameters,
                 allow_other_robot: bool = False):
        path = find(path)
        try:
            data = _content(path)
            has_checksum = policy_checksum.verify(data)
            self._session = _session(data)
            self.contract = PolicyContract.from_metadata(_metadata(self._session))
            warning = self.contract.check(robot, allow_other_robot)
            size = self.contract.observation_size
            _check_tensor('input', self._session.get_inputs(), INPUT, size)
            _check_tensor('output', self._session.get_outputs(), OUTPUT, len(ACTIONS))
            if not has_checksum:
                raise ParameterError(f"metadata '{policy_checksum.KEY}' is missing; "
                                     f'{policy_checksum.ADD}')
            self._bind(size)
            self._warm_up()
        except ParameterError as error:
            raise ParameterError(f'policy {path}: {shortened(str(error), LONGEST)}') from None
        if warning:
            log.warning('policy %s: %s', path, warning)

    def __call__(self, observation: list[float]) -> list[float]:
        """Action (8) for an observation (n), both in plain numbers."""
        self._input[0] = observation
        self._session.run_with_iobinding(self._binding)
        return self._output[0].tolist()

    def _bind(self, size):
        """Let the session read and write the same two arrays at every call."""
        self._input = np.zeros((1, size), np.float32)
        self._output = np.zeros((1, len(ACTIONS)), np.float32)
        binding = self._binding = self._session.io_binding()
        for bind, name, array in ((binding.bind_input, INPUT, self._input),
                                  (binding.bind_output, OUTPUT, self._output)):
            bind(name, 'cpu', 0, np.float32, array.shape, array.ctypes.data)

    def _warm_up(self):
        """Call as in level flight; refuse a network whose output is not finite."""
        rest: list[float] = []
        for block in self.contract.observations:
            rest += LEVEL if 'attitude' in block.name else [0.0] * block.size
        try:
            for _ in range(WARM_UP):
                action = self(rest)
        except Exception as error:
            raise ParameterError(f'cannot be run ({_reason(error)})') from None
        if not all(map(isfinite, action)):
            raise ParameterError('the action for a robot at rest is not finite')


def find(path: str | Path) -> Path:
    """
    Locate a policy: an absolute path, or one in the package's share or the present folder.

    Raises:
        ParameterError: there is no such file.

    """
    path = Path(path)
    try:
        found = share_path(str(path))
    except FileNotFoundError:
        found = path
    if not found.is_file():
        where = '' if path.is_absolute() else \
            f", neither in the package's share nor in {Path.cwd()}"
        raise ParameterError(f'policy {path}: no such file{where}')
    return found


def _content(path):
    """Bytes of the file, read once for checks and use."""
    try:
        with open(path, 'rb') as file:
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise ParameterError(f'cannot be read ({error.strerror})') from None
    if len(data) > LARGEST:
        raise ParameterError(f'larger than {LARGEST} bytes')
    return data


def _metadata(session):
    """Custom metadata of a file."""
    try:
        return session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise ParameterError(f'metadata that are no UTF-8 text ({error.reason})') from None


def _session(data):
    """Open a file's content with onnxruntime: one thread, without spinning."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    options.add_session_config_entry('session.inter_op.allow_spinning', '0')
    options.log_severity_level = FATAL_ONLY
    try:
        return onnxruntime.InferenceSession(data, options,
                                            providers=['CPUExecutionProvider'])
    except Exception as error:      # its exceptions have no common base class
        raise ParameterError(f'not a readable ONNX file, possibly truncated '
                             f'({_reason(error)})') from None


def _reason(error):
    """The informative end of onnxruntime's messages, which begin with codes."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return shortened(lines[0].split(' : ')[-1])


def _check_tensor(kind, found, name, size):
    """One tensor of the contract's name, type and size (1, n)."""
    if len(found) != 1 or found[0].name != name:
        names = ', '.join(repr(tensor.name) for tensor in found) or 'none'
        raise ParameterError(f'{kind}: expected one, {name!r}, found {names}')
    tensor = found[0]
    if tensor.type != 'tensor(float)':
        raise ParameterError(f'{kind} {name}: expected tensor(float), found {tensor.type}')
    shape = list(tensor.shape)
    # the batch may be left open, the size may not
    if len(shape) != 2 or shape[1] != size or (isinstance(shape[0], int) and shape[0] != 1):
        raise ParameterError(f'{kind} {name}: expected size (1, {size}), found '
                             f"({', '.join(map(str, shape))})")
