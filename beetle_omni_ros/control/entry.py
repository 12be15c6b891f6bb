"""What is known of a controller before it flies, and how it is built from its class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
import inspect
from math import inf
from pathlib import Path
import re
import sys
import traceback
from typing import Any, TYPE_CHECKING

from beetle_omni_ros.control.base import Controller, reach_of
from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

if TYPE_CHECKING:       # which imports CasADi, and a list of names needs none
    from beetle_omni_ros.robot.parameters import RobotParameters

PERIOD = 0.01               # [s] of a controller whose class does not say
LONGEST_PERIOD = 1.0        # [s]
METHODS = {'step': ('state', 'target'), 'reset': ()}     # and their arguments
NAME = re.compile(r'[a-z][a-z0-9_]*')
# `<name>_node` and `<name>/command` are taken, or the word means something in results and states.
RESERVED = ('controller', 'ekf', 'joint_bridge', 'meta', 'none', 'operator', 'recorder',
            'reference', 'rotor_bridge', 'sim', 'supervisor', 'viewer')


@dataclass(frozen=True)
class Line:
    """How a controller is drawn: colour, dashes, marker; no colour: one is chosen."""

    colour: str = ''
    dashes: str | tuple = '-'
    marker: str = 'o'


@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """
    What a user gives in place of a controller's own files.

    Attributes:
        parameters: file of parameters.
        policy: network.
        allow_other_robot: fly a policy that was trained for other robot parameters.

    """

    parameters: Path | None = None
    policy: Path | None = None
    allow_other_robot: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerEntry:
    """
    One controller; everything that takes a controller's name reads it here.

    Attributes:
        name: of its results, its topic ``<name>/command`` and its node ``<name>_node``.
        controller: class, or 'package.module:Class', called with the robot and, where its
            signature has them, ``parameters`` and ``options``.
        spec: by which another process finds it; '' means by its name.
        label: short, for headings of figures.
        description: one line.
        period: between its commands, as far as is known before it is built [s].
        parameters: class of its parameters (:mod:`robot.schema`) or 'package.module:Class'.
        parameters_file: shipped file of them; in the package's share, or any path.
        fixed: parameters that are its own whatever the shipped file says.
        policy_file: network that it needs; '' for none. Its parameters then have ``policy`` and
            ``allow_other_robot``.
        option: of the command line that replaces the one file of this controller alone.
        guidance: what moves the targets that it is given, see :mod:`control.guidance`.
        flies_degraded: whether it can fly with actuators missing (``set_health``).
        stands_by: whether it is in the ROS graph beside another one that flies.
        compared: whether `beetle_omni compare` flies it when nobody says what.
        cost: core seconds for a simulated second; orders flights, decides no result.
        line: how it is drawn.

    """

    name: str
    controller: str | Callable[..., Controller]
    spec: str = ''
    label: str = ''
    description: str = ''
    period: float = PERIOD
    parameters: str | type | None = None
    parameters_file: str = ''
    fixed: Mapping[str, Any] = field(default_factory=dict)
    policy_file: str = ''
    option: str = ''
    guidance: str = 'none'
    flies_degraded: bool = False
    stands_by: bool = False
    compared: bool = False
    cost: float = 0.1
    line: Line = field(default_factory=Line)

    def __post_init__(self):
        """Refuse a name that cannot be one."""
        if not NAME.fullmatch(self.name) or self.name in RESERVED:
            raise ParameterError(
                f"controller '{self.name}': not usable as a name; expected small letters, digits "
                f"and _, and none of {', '.join(RESERVED)}")

    @property
    def reference(self) -> str:
        """By which another process finds it: the name, or where its class is."""
        return self.spec or self.name

    @property
    def file_key(self) -> str:
        """Parameter of its node that names another parameter file."""
        return f'{self.name}_file'

    @property
    def parameter_class(self) -> type | None:
        """Class of its parameters, or None."""
        if isinstance(self.parameters, str):
            return loaded(self.parameters, self.reference)
        return self.parameters

    def file(self) -> Path | None:
        """Locate its shipped parameter file."""
        if not self.parameters_file:
            return None
        path = Path(self.parameters_file)
        return path if path.is_file() else share_path(self.parameters_file)

    def completed(self, mapping: dict, from_user: bool) -> dict:
        """Values of a parameter file with the controller's own; a user's file goes before."""
        return {**self.fixed, **mapping} if from_user else {**mapping, **self.fixed}

    def load_parameters(self, options: ControllerOptions = ControllerOptions()):
        """
        Parameters as a file and the options say; None for a controller without.

        Raises:
            ParameterError: a file for a controller that reads none, or an unusable one.

        """
        kind = self.parameter_class
        if kind is None:
            if options.parameters:
                raise ParameterError(f"controller '{self.reference}': reads no parameter file, "
                                     f'given {options.parameters}')
            return None
        file = options.parameters or self.file()
        mapping = schema.load_yaml(file) if file else {}
        parameters = schema.bind(kind, self.completed(mapping, bool(options.parameters)),
                                 str(file or ''))
        if not (self.policy_file and hasattr(parameters, 'policy')):
            return parameters
        return replace(parameters, policy=str(options.policy or self.policy_file),
                       allow_other_robot=parameters.allow_other_robot
                       or options.allow_other_robot)

    def make(self, robot: RobotParameters, options: ControllerOptions = ControllerOptions(),
             parameters: Any = None) -> Controller:
        """
        Build the controller.

        Args:
            robot: what it believes about the robot.
            options: in place of its own files.
            parameters: in place of those that files and options give.

        Raises:
            ParameterError: what is wrong with its class or its files, in one line.

        """
        builder = self.builder()
        if inspect.isclass(builder):
            self._check_methods(builder)
        given = {'parameters': parameters if parameters is not None
                 else self.load_parameters(options), 'options': options}
        names = _names(builder)
        keywords = {key: value for key, value in given.items()
                    if key in names and value is not None}
        arguments = [robot] if names is ANY or set(names) - set(given) else []
        if names and names is not ANY:
            self._check_call(builder, arguments, keywords)
        try:
            controller = builder(*arguments, **keywords)
        except (ParameterError, FileNotFoundError, ImportError):
            raise
        except Exception as error:
            if isinstance(self.controller, str):    # ours: a fault of the package
                raise
            raise ParameterError(f"controller '{self.reference}': building it raised "
                                 f'{_told(error)}') from error
        self._check(controller)
        return controller

    def reach(self, robot: RobotParameters, options: ControllerOptions = ControllerOptions()
              ) -> float:
        """
        Farthest target that it flies to [m]; inf where it does not say.

        What is loaded late tells by its parameters, for building may take seconds; another one
        is built for the answer.

        Raises:
            ParameterError: as :meth:`make`.

        """
        if isinstance(self.controller, str) and self.parameters is not None:
            return float(getattr(self.load_parameters(options), 'reach', inf))
        return reach_of(self.make(robot, options))

    def builder(self) -> Callable[..., Controller]:
        """Class or function that builds it."""
        return loaded(self.controller, self.reference) if isinstance(self.controller, str) \
            else self.controller

    def _check_call(self, builder, arguments, keywords):
        signature = inspect.signature(builder)
        try:
            signature.bind(*arguments, **keywords)
        except TypeError as error:
            raise ParameterError(
                f"controller '{self.reference}': cannot be built from {signature} ({error}); "
                'expected (robot), also with parameters or options') from None

    def _check_methods(self, controller):
        for method, expected in METHODS.items():
            if not callable(getattr(controller, method, None)):
                raise ParameterError(f"controller '{self.reference}': no method {method}"
                                     f"({', '.join(expected)}); see control/base.py")

    def _check(self, controller):
        """What is built must be a controller."""
        self._check_methods(controller)
        for method, expected in METHODS.items():
            call = getattr(controller, method)
            try:
                inspect.signature(call).bind(*expected)
            except TypeError:
                raise ParameterError(
                    f"controller '{self.reference}': {method}{inspect.signature(call)}, "
                    f"expected {method}({', '.join(expected)})") from None
            except ValueError:
                pass        # a compiled method without a signature
        period = getattr(controller, 'period', None)
        if not isinstance(period, (int, float)) or not 0 < period <= LONGEST_PERIOD:
            raise ParameterError(f"controller '{self.reference}': period is {period!r}, expected "
                                 f'the time between two steps, above 0 and at most '
                                 f'{LONGEST_PERIOD:g} s')
        reach = getattr(controller, 'reach', inf)
        if not isinstance(reach, (int, float)) or not reach > 0:
            raise ParameterError(f"controller '{self.reference}': reach is {reach!r}, expected "
                                 'the distance of the farthest target [m], above 0')


def entry_of(found: Any, spec: str, name: str = '') -> ControllerEntry:
    """
    Make an entry of what a reference leads to.

    Args:
        found: an entry, a class, or a function that builds a controller. A class may have
            ``name``, ``Parameters``, ``parameters_file``, ``policy_file`` and ``guidance``.
        spec: by which other processes find it.
        name: under which it is registered; '' takes its own.

    Raises:
        ParameterError: it cannot be one.

    """
    if isinstance(found, ControllerEntry):
        return replace(found, name=name or found.name, spec=spec)
    if not callable(found):
        raise ParameterError(f"controller '{spec}': a {type(found).__name__}, expected a class "
                             'with step(state, target), reset() and period')
    own = vars(found) if inspect.isclass(found) else {}
    named = own.get('name', '')
    period = getattr(found, 'period', PERIOD)
    file = getattr(found, 'parameters_file', '')
    module = getattr(sys.modules.get(found.__module__), '__file__', None)
    beside = Path(module).parent / file if file and module else None
    parameters = getattr(found, 'Parameters', None)
    if parameters is not None and not (isinstance(parameters, type) and is_dataclass(parameters)):
        raise ParameterError(f"controller '{spec or name}': its Parameters are no dataclass of "
                             'robot.schema.parameter fields')
    return ControllerEntry(
        name=name or (named if isinstance(named, str) and named else _snake(found.__name__)),
        controller=found, spec=spec, label=found.__name__,
        description=(found.__doc__ or '').strip().partition('\n')[0],
        period=period if isinstance(period, (int, float)) else PERIOD,
        parameters=parameters,
        parameters_file=str(beside) if beside and beside.is_file() else file,
        policy_file=getattr(found, 'policy_file', ''),
        guidance=getattr(found, 'guidance', 'none') if isinstance(
            getattr(found, 'guidance', 'none'), str) else 'none',
        flies_degraded=hasattr(found, 'set_health'))


def absolute(spec: str) -> str:
    """The spec with a file's absolute path, good in any folder."""
    module, _, name = spec.rpartition(':')
    return f'{Path(module).absolute()}:{name}' if module.endswith('.py') else spec


def loaded(reference: str, spec: str) -> Any:
    """
    Import what ``package.module:Name`` or ``path/to/file.py:Name`` leads to.

    Modules are looked for in the working folder, too.

    Args:
        reference: the above.
        spec: of the controller that needs it, for messages.

    Raises:
        ParameterError: what is missing, in one line.

    """
    place, _, name = reference.rpartition(':')
    if not place or not name.isidentifier():
        raise ParameterError(f"controller '{spec}': expected package.module:Class or "
                             'path/to/file.py:Class')
    module = _module(place, spec)
    if not hasattr(module, name):
        there = [key for key, value in vars(module).items() if inspect.isclass(value)
                 and value.__module__ == module.__name__]
        raise ParameterError(f"controller '{spec}': no '{name}' in {place}; its classes: "
                             f"{', '.join(there) or 'none'}")
    return getattr(module, name)


def _module(place, spec):
    if place.endswith('.py'):
        path = Path(place).absolute()
        if not path.is_file():
            raise ParameterError(f"controller '{spec}': {path}: no such file")
        name = re.sub(r'\W', '_', str(path.with_suffix('')))
        folder = str(path.parent)
    else:
        name, folder = place, str(Path.cwd())
    if name in sys.modules:
        return sys.modules[name]
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        if not place.endswith('.py'):
            return import_module(name)
        file = spec_from_file_location(name, path)
        if file is None or file.loader is None:
            raise ParameterError(f"controller '{spec}': {path}: no Python module")
        module = sys.modules[name] = module_from_spec(file)
        try:
            file.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module
    except ModuleNotFoundError as error:
        if error.name and (name == error.name or name.startswith(error.name + '.')):
            raise ParameterError(f"controller '{spec}': no module '{error.name}' in "
                                 f'{folder} or where Python looks') from None
        raise ParameterError(f"controller '{spec}': {place} needs the module '{error.name}', "
                             'which is not installed') from error
    except Exception as error:
        raise ParameterError(f"controller '{spec}': importing {place} raised "
                             f'{_told(error)}') from error


def _told(error):
    """Error in one line, with where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    at = f' ({Path(frames[-1].filename).name}, line {frames[-1].lineno})' if frames else ''
    return f'{type(error).__name__}: {error}{at}'


ANY = frozenset({'parameters', 'options'})      # of what has no signature to ask


def _names(builder):
    """Names of the arguments that a class or function takes."""
    if inspect.isclass(builder) and not any(
            {'__init__', '__new__'} & set(vars(base)) and not getattr(base, '_is_protocol', False)
            for base in builder.__mro__[:-1]):
        return []       # Protocol's own signature says otherwise
    try:
        return list(inspect.signature(builder).parameters)
    except (TypeError, ValueError):
        return ANY


def _snake(name):
    return re.sub(r'(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])', '_', name).lower()
