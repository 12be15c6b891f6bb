"""
The table of controllers, for all programs that accept a controller's name.

Others are given as ``path/to/file.py:Class`` or ``package.module:Class``. A controller is imported
when it is built, because the large libraries that it needs take seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
import inspect
from pathlib import Path
import re
import sys
from typing import Any, TYPE_CHECKING

from beetle_omni_ros.control.base import Controller, error_text, reach_of
from beetle_omni_ros.model import schema
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError

if TYPE_CHECKING:       # imports CasADi, which a list of names does not need
    from beetle_omni_ros.model.parameters import RobotParameters

LONGEST_PERIOD = 1.0        # [s]
METHODS = {'step': ('state', 'target'), 'reset': ()}     # and their arguments
CLASS = 'FILE.py:Class or package.module:Class'    # reference to an unregistered controller
# Names whose `<name>_node` or `<name>/command` exists, and words of results and states.
RESERVED = ('controller', 'ekf', 'joint_bridge', 'meta', 'none', 'operator', 'recorder',
            'reference', 'rotor_bridge', 'sim', 'supervisor', 'viewer')


@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """Files of parameters and network that replace a controller's own ones, and switches."""

    parameters: Path | None = None
    policy: Path | None = None
    without: str = ''                   # layers of the guidance that are off


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerEntry:
    """One controller; all programs that accept a controller's name use this entry."""

    name: str               # of its results, its topic '<name>/command' and node '<name>_node'
    # Class or function, or 'package.module:Class', called with the robot and, where its signature
    # has them, `parameters`. Its `Parameters` is the class of its parameters.
    controller: str | Callable[..., Controller]
    spec: str = ''          # reference by which another process finds it; '': its name
    label: str = ''         # short, for headings of figures
    description: str = ''
    parameters_file: str = ''   # shipped file of them; in the package's share, or any path
    policy_file: str = ''       # its network
    flies_degraded: bool = False    # with failed actuators
    stands_by: bool = False     # in the ROS graph
    compared: bool = False  # by default

    @property
    def reference(self) -> str:
        """Reference by which another process finds it: its name, or the path of its class."""
        return self.spec or self.name

    @property
    def builder(self) -> Callable[..., Controller]:
        """Class or function that builds it."""
        return loaded(self.controller) if isinstance(self.controller, str) else self.controller

    @property
    def parameter_class(self) -> type | None:
        """Class of its parameters, or None."""
        return getattr(self.builder, 'Parameters', None)

    def load_parameters(self, options: ControllerOptions = ControllerOptions()):
        """Parameters from a file and the options; None for a controller without parameters."""
        kind, file = self.parameter_class, options.parameters
        if kind is None:
            return None
        if not file and self.parameters_file:
            file = Path(self.parameters_file)
            try:
                file = file if file.is_file() else share_path(self.parameters_file)
            except FileNotFoundError:
                raise ParameterError(f"controller '{self.reference}': parameters_file '{file}': "
                                     'not found') from None
        parameters = schema.bind(kind, schema.load_yaml(file) if file else {}, str(file or ''))
        given = {'policy': str(options.policy or ''), 'without': options.without}
        return replace(parameters, **{key: value for key, value in given.items()
                                      if value and hasattr(parameters, key)})

    def make(self, robot: RobotParameters, options: ControllerOptions = ControllerOptions(),
             parameters: Any = None) -> Controller:
        """Build the controller; ``parameters`` replace those of files and options."""
        builder, at = self.builder, f"controller '{self.reference}': "
        parameters = parameters or self.load_parameters(options)
        try:
            # Plain arguments: those of Protocol's own constructor, (*args, **kwargs), do not count
            names = {name for name, each in inspect.signature(builder).parameters.items()
                     if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
            controller = builder(*[robot][:len(names - {'parameters'})], **(
                {'parameters': parameters} if 'parameters' in names else {}))
        except ParameterError:
            raise
        except Exception as error:
            raise ParameterError(f'{at}building it raised {error_text(error)}') from error
        for method, expected in METHODS.items():
            call: Any = getattr(controller, method, None)
            try:
                inspect.signature(call).bind(*expected)
            except TypeError:
                raise ParameterError(f"{at}expected a method {method}({', '.join(expected)}); see "
                                     'control/base.py') from None
        period = getattr(controller, 'period', None)
        if not isinstance(period, (int, float)) or not 0 < period <= LONGEST_PERIOD:
            raise ParameterError(f'{at}period is {period!r}, expected the time between two steps, '
                                 f'above 0 and at most {LONGEST_PERIOD:g} s')
        return controller

    def reach(self, robot: RobotParameters) -> float:
        """Largest distance to a target [m], from its parameters: building may take seconds."""
        parameters = self.load_parameters()
        return reach_of(parameters if hasattr(parameters, 'reach') else self.make(robot))


SHIPPED: Mapping[str, ControllerEntry] = {
    name: ControllerEntry(name=name, parameters_file=f'params/{name}.yaml', **fields)
    for name, fields in schema.read_yaml(Path(__file__).with_name('controllers.yaml')).items()}
DEFAULT = next(iter(SHIPPED))       # the default controller
STANDING_BY = tuple(name for name, entry in SHIPPED.items() if entry.stands_by)
COMPARED = sorted((name for name, entry in SHIPPED.items() if entry.compared),
                  key=lambda name: not SHIPPED[name].policy_file)      # policies first
# Kind of a file -> controller for which programs accept another one.
OWNER = {'parameters': 'nmpc', 'policy': 'rl'}
_ADDED: dict[str, ControllerEntry] = {}     # of this process alone


def names() -> list[str]:
    """Every registered name, the shipped ones first."""
    return [*SHIPPED, *_ADDED]


def snake_case(name: str) -> str:
    """Small letters and _ of the name of a class."""
    return re.sub(r'(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])', '_', name).lower()


def entry_of(found: Any, spec: str) -> ControllerEntry:
    """
    Make an entry from a class, or a function that builds a controller; or a ParameterError.

    A class may have ``name``, ``Parameters``, ``parameters_file`` and ``policy_file``.
    """
    if not callable(found):
        raise ParameterError(f"controller '{spec}': a {type(found).__name__}, expected a class "
                             'with step(state, target), reset() and period')
    # an inherited name would be another controller's
    name = vars(found).get('name') or snake_case(found.__name__)
    if not re.fullmatch(r'[a-z][a-z0-9_]*', name) or name in (*SHIPPED, *RESERVED):
        raise ParameterError(f"controller '{spec or name}': '{name}' is no usable name; expected "
                             "small letters, digits and _ (the class's attribute 'name'), and "
                             f"none of {', '.join((*SHIPPED, *RESERVED))}")
    file = getattr(found, 'parameters_file', '')
    beside = Path(getattr(sys.modules.get(found.__module__), '__file__', None) or '').parent / file
    return ControllerEntry(
        name=name, controller=found, spec=spec,
        description=(found.__doc__ or '').strip().partition('\n')[0],
        parameters_file=str(beside) if file and beside.is_file() else file,
        policy_file=getattr(found, 'policy_file', ''),
        flies_degraded=hasattr(found, 'set_health'))


def add(found: Any) -> ControllerEntry:
    """
    Register a class, or a function that builds a controller, in this process under its name.

    It replaces one of the same name, for example when a notebook cell runs again.
    """
    entry = entry_of(found, '')
    _ADDED[entry.name] = entry
    return entry


def find(reference: str) -> ControllerEntry:
    """
    Find a registered name, ``package.module:Class`` or ``path/to/file.py:Class``.

    Raises:
        ParameterError: there is none, or it cannot be loaded; one line.

    """
    place, _, name = reference.rpartition(':')
    if place or reference.endswith('.py'):
        return _named(f'{Path(place).absolute()}:{name}' if place.endswith('.py') else reference)
    if entry := SHIPPED.get(reference) or _ADDED.get(reference):
        return entry
    raise ParameterError(f"controller '{reference}': expected one of {', '.join(names())}, or "
                         + CLASS)


@cache
def _named(spec: str) -> ControllerEntry:
    return entry_of(loaded(spec), spec)


def find_all(references: Iterable[str]) -> list[ControllerEntry]:
    """Look several controllers up; no two of them may have one name."""
    entries: dict[str, ControllerEntry] = {}
    for reference in references:
        entry = find(reference)
        if entry.name in entries:
            raise ParameterError(f"controllers '{entries[entry.name].reference}' and "
                                 f"'{entry.reference}': both are called {entry.name}; expected "
                                 "different names (a class's attribute 'name')")
        entries[entry.name] = entry
    return list(entries.values())


def loaded(reference: str, what: str = 'controller') -> Any:
    """Import ``package.module:Name`` or ``path/to/file.py:Name``, also from the working folder."""
    place, _, name = reference.rpartition(':')
    if not place or not name.isidentifier():
        raise ParameterError(f"{what} '{reference}': expected {CLASS}")
    if place.endswith('.py') and not Path(place).is_file():
        raise ParameterError(f"{what} '{reference}': no such file")
    folder = str(Path(place).parent if place.endswith('.py') else Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        module = _executed(Path(place)) if place.endswith('.py') else import_module(place)
    except ModuleNotFoundError as error:
        raise ParameterError(f"{what} '{reference}': no module '{error.name}'") from None
    except Exception as error:
        raise ParameterError(f"{what} '{reference}': importing {place} raised "
                             f'{error_text(error)}') from error
    if not hasattr(module, name):
        there = [key for key, value in vars(module).items() if inspect.isclass(value)
                 and value.__module__ == module.__name__]
        raise ParameterError(f"{what} '{reference}': no '{name}' in {place}; its classes: "
                             f"{', '.join(there) or 'none'}")
    return getattr(module, name)


def _executed(path):
    """Import a file once, under a name that no package has."""
    name = re.sub(r'\W', '_', str(path.with_suffix('')))
    if name not in sys.modules:
        file: Any = spec_from_file_location(name, path)
        module = sys.modules[name] = module_from_spec(file)
        try:
            file.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def pilot(among: Iterable[str] | None = None) -> str:
    """First of the shipped controllers ``among`` names that flies with lost actuators, or ''."""
    there = set(SHIPPED if among is None else among)
    return next((name for name, entry in SHIPPED.items()
                 if entry.flies_degraded and name in there), '')
