"""
The table of controllers, for all programs that accept a controller's name.

Names are entry points of the group ``beetle_omni_ros.controllers``, which any installed package
may extend. ``package.module:Class`` and ``path/to/file.py:Class`` refer to a class that is not
registered. The entry points of this package are read from :mod:`control.shipped`, so that a
checkout needs no installation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib import metadata
from typing import Any, TYPE_CHECKING

from beetle_omni_ros.control import shipped
from beetle_omni_ros.control.base import Controller
from beetle_omni_ros.control.entry import (
    absolute,
    CLASS,
    ControllerEntry,
    ControllerOptions,
    entry_of,
    loaded,
)
from beetle_omni_ros.robot.schema import ParameterError

if TYPE_CHECKING:       # imports CasADi, which a list of names does not need
    from beetle_omni_ros.robot.parameters import RobotParameters

GROUP = 'beetle_omni_ros.controllers'
SHIPPED: Mapping[str, ControllerEntry] = {
    name: entry for name, entry in vars(shipped).items() if isinstance(entry, ControllerEntry)}
DEFAULT = next(iter(SHIPPED))       # the default controller


@cache
def _points() -> dict[str, metadata.EntryPoint]:
    """Entry points of other packages by name; the shipped names stay the package's own."""
    return {point.name: point for point in sorted(metadata.entry_points(group=GROUP))
            if point.name not in SHIPPED}


_ADDED: dict[str, ControllerEntry] = {}     # of this process alone


def names() -> list[str]:
    """Every registered name, the shipped ones first."""
    return list(dict.fromkeys((*SHIPPED, *_points(), *_ADDED)))


def add(found: Any) -> ControllerEntry:
    """
    Register a class, or a function that builds a controller, in this process under its name.

    A controller of the same name that was added before is replaced, for example when a notebook
    cell runs again.

    Raises:
        ParameterError: it is no controller, or its name is used by another package.

    """
    entry = entry_of(found, '')
    if entry.name in SHIPPED or entry.name in _points():
        raise ParameterError(_taken(entry.name, entry.name))
    _ADDED[entry.name] = entry
    return entry


def find(reference: str) -> ControllerEntry:
    """
    Look a controller up.

    Args:
        reference: a registered name, ``package.module:Class`` or ``path/to/file.py:Class``.

    Raises:
        ParameterError: there is none, or it cannot be loaded; one line.

    """
    if reference in SHIPPED:
        return SHIPPED[reference]
    if ':' in reference or reference.endswith('.py'):
        return _named(absolute(reference))
    if reference in _ADDED:
        return _ADDED[reference]
    if reference in _points():
        return _registered(reference)
    raise ParameterError(f"controller '{reference}': expected one of {', '.join(names())}, or "
                         + CLASS)


def find_all(references: Iterable[str]) -> list[ControllerEntry]:
    """
    Look several controllers up; no two of them may have one name.

    Raises:
        ParameterError: as :func:`find`, or a name twice.

    """
    entries: dict[str, ControllerEntry] = {}
    for reference in references:
        entry = find(reference)
        if entry.name in entries:
            raise ParameterError(f"controllers '{entries[entry.name].reference}' and "
                                 f"'{entry.reference}': both are called {entry.name}; expected "
                                 "different names (a class's attribute 'name')")
        entries[entry.name] = entry
    return list(entries.values())


@cache
def _named(spec: str) -> ControllerEntry:
    entry = entry_of(loaded(spec, spec), spec)
    if entry.name in SHIPPED or entry.name in _points():
        raise ParameterError(_taken(spec, entry.name))
    return entry


def _taken(reference, name):
    return f"controller '{reference}': '{name}' is a registered controller's name; expected " \
           "another one (the class's attribute 'name')"


@cache
def _registered(name: str) -> ControllerEntry:
    return entry_of(loaded(_points()[name].value.replace(' ', ''), name), '', name)


def make(reference: str, robot: RobotParameters,
         options: ControllerOptions = ControllerOptions()) -> Controller:
    """Build a controller, see :func:`find` and :meth:`ControllerEntry.make`."""
    return find(reference).make(robot, options)


def pilot(among: Iterable[str] | None = None) -> str:
    """
    Name of the controller that lands the robot when actuators are lost.

    Args:
        among: available names; None: all registered names.

    Returns:
        The first shipped controller that can; '' if none is available.

    """
    there = set(SHIPPED if among is None else among)
    return next((name for name, entry in SHIPPED.items()
                 if entry.flies_degraded and name in there), '')


def standing_by() -> list[str]:
    """Names of the controllers that run on standby in the ROS graph."""
    return [name for name, entry in SHIPPED.items() if entry.stands_by]


def compared() -> list[str]:
    """Names that are compared by default; policies first."""
    return sorted((name for name, entry in SHIPPED.items() if entry.compared),
                  key=lambda name: not SHIPPED[name].policy_file)


def owner(option: str) -> str:
    """Name of the controller whose file an option of the command line replaces."""
    return next(name for name, entry in SHIPPED.items() if entry.option == option)


__all__ = ['add', 'CLASS', 'compared', 'ControllerEntry', 'ControllerOptions', 'DEFAULT', 'find',
           'find_all', 'GROUP', 'make', 'names', 'owner', 'pilot', 'SHIPPED', 'standing_by']
