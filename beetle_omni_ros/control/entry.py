"""Registry entries of controllers, and how a controller is built from its class."""

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
from typing import Any, TYPE_CHECKING

from beetle_omni_ros.control.base import Controller, error_text, reach_of
from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

if TYPE_CHECKING:       # imports CasADi, which a list of names does not need
    from beetle_omni_ros.robot.parameters import RobotParameters

PERIOD = 0.01               # [s] of a controller whose class has no period
LONGEST_PERIOD = 1.0        # [s]
METHODS = {'step': ('state', 'target'), 'reset': ()}     # and their arguments
CLASS = 'FILE.py:Class or package.module:Class'    # reference to an unregistered controller
NAME = re.compile(r'[a-z][a-z0-9_]*')
# Names whose `<name>_node` or `<name>/command` exists, and words of results and states.
RESERVED = ('controller', 'ekf', 'joint_bridge', 'meta', 'none', 'operator', 'recorder',
            'reference', 'rotor_bridge', 'sim', 'supervisor', 'viewer')


@dataclass(frozen=True)
class Line:
    """Line style of a controller in figures; without a colour one is chosen."""

    colour: str = ''
    dashes: str | tuple = '-'
    marker: str = 'o'


@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """
    Files that replace a controller's own files.

    Attributes:
        parameters: file of parameters.
        policy: network.
        allow_other_robot: fly a policy that was trained for other robot parameters.
        without: layers of the guidance that are off.

    """

    parameters: Path | None = None
    policy: Path | None = None
    allow_other_robot: bool = False
    without: str = ''


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerEntry:
    """
    One controller; all programs that accept a controller's name use this entry.

    Attributes:
        name: of its results, its topic ``<name>/command`` and its node ``<name>_node``.
        controller: class, or 'package.module:Class', called with the robot and, where its
            signature has them, ``parameters`` and ``options``.
        spec: reference by which another process finds it; '' means its name.
        label: short, for headings of figures.
        description: one line.
        period: between its commands, if known before it is built [s].
        parameters: class of its parameters (:mod:`robot.schema`) or 'package.module:Class'.
        parameters_file: shipped file of them; in the package's share, or any path.
        fixed: parameters that override the shipped file.
        policy_file: its network; '' for none. With a network its parameters have ``policy`` and
            ``allow_other_robot``.
        option: of the command line that replaces the file of this controller only.
        guidance: names the functions that modify its targets, see :mod:`control.guidance`.
        flies_degraded: whether it can fly with failed actuators (``set_health``).
        stands_by: whether it runs in the ROS graph on standby.
        compared: whether `beetle_omni compare` flies it by default.
        cost: core seconds for a simulated second, to order flights; without influence on results.
        line: style in figures.

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
        """Refuse an invalid name."""
        if not NAME.fullmatch(self.name) or self.name in RESERVED:
            raise ParameterError(
                f"controller '{self.name}': not usable as a name; expected small letters, digits "
                f"and _, and none of {', '.join(RESERVED)}")

    @property
    def reference(self) -> str:
        """Reference by which another process finds it: its name, or the path of its class."""
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
        """Values of a parameter file and of ``fixed``; a user's file takes precedence."""
        return {**self.fixed, **mapping} if from_user else {**mapping, **self.fixed}

    def load_parameters(self, options: ControllerOptions = ControllerOptions()):
        """
        Parameters from a file and the options; None for a controller without parameters.

        Raises:
            ParameterError: an unusable file, or a file for a controller without parameters.

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
        if options.without:
            if not hasattr(parameters, 'without'):
                raise ParameterError(f"--without {options.without}: controller "
                                     f"'{self.reference}' has no layers of guidance")
            parameters = replace(parameters, without=options.without)
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
            robot: its model of the robot.
            options: files that replace its own.
            parameters: replace those of files and options.

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
            if isinstance(self.controller, str):    # a shipped controller: a defect of the package
                raise
            raise ParameterError(f"controller '{self.reference}': building it raised "
                                 f'{error_text(error)}') from error
        self._check(controller)
        return controller

    def reach(self, robot: RobotParameters, options: ControllerOptions = ControllerOptions()
              ) -> float:
        """
        Largest distance to a target [m]; inf if it has none.

        For controllers with a late import the value comes from their parameters, because building
        them may take seconds. Other controllers are built.

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
        """Refuse a result that is no controller."""
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
    Make an entry from an entry, a class or a function.

    Args:
        found: an entry, a class, or a function that builds a controller. A class may have
            ``name``, ``Parameters``, ``parameters_file``, ``policy_file`` and ``guidance``.
        spec: reference by which other processes find it.
        name: under which it is registered; '' uses its own name.

    Raises:
        ParameterError: it cannot be registered.

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
    """The spec with an absolute path, valid in any folder."""
    module, _, name = spec.rpartition(':')
    return f'{Path(module).absolute()}:{name}' if module.endswith('.py') else spec


def loaded(reference: str, spec: str) -> Any:
    """
    Import the object of ``package.module:Name`` or ``path/to/file.py:Name``.

    Modules are also searched in the working folder.

    Args:
        reference: the above.
        spec: of the controller that needs it, for messages.

    Raises:
        ParameterError: what is missing, in one line.

    """
    place, _, name = reference.rpartition(':')
    if reference.endswith('.py'):       # a file without a class
        place, name = reference, ''
    elif not place or not name.isidentifier():
        raise ParameterError(f"controller '{spec}': expected {CLASS}")
    module = _module(place, spec)
    if not name or not hasattr(module, name):
        there = [key for key, value in vars(module).items() if inspect.isclass(value)
                 and value.__module__ == module.__name__]
        problem = f"no '{name}' in {place}" if name else f'expected {place}:Class'
        raise ParameterError(f"controller '{spec}': {problem}; its classes: "
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
                                 f'{folder} or on the Python path') from None
        raise ParameterError(f"controller '{spec}': {place} needs the module '{error.name}', "
                             'which is not installed') from error
    except Exception as error:
        raise ParameterError(f"controller '{spec}': importing {place} raised "
                             f'{error_text(error)}') from error


ANY = frozenset({'parameters', 'options'})      # if the object has no signature


def _names(builder):
    """Names of the arguments that a class or function takes."""
    if inspect.isclass(builder) and not any(
            {'__init__', '__new__'} & set(vars(base)) and not getattr(base, '_is_protocol', False)
            for base in builder.__mro__[:-1]):
        return []       # the signature of Protocol itself differs
    try:
        return list(inspect.signature(builder).parameters)
    except (TypeError, ValueError):
        return ANY


def _snake(name):
    return re.sub(r'(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])', '_', name).lower()
