"""
A parameter dataclass declared as ROS parameters.

ROS ignores an override of an undeclared key, and a bad value causes a traceback. Here, the checks
of the parameter files refuse both at the start of the node, in one line that names the key.
"""

from collections.abc import Callable
from dataclasses import make_dataclass, MISSING

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node

from beetle_omni_ros.model import schema
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import NAMES, ParameterError

# Overrides that ROS itself adds.
CLOCK = 'use_sim_time'
ROS_OWN = (CLOCK, 'start_type_description_service')
ROS_OWN_PREFIX = 'qos_overrides.'


def file_parameter(what: str = 'robot file'):
    """Make the parameter of a node that names a file."""
    return schema.parameter('', doc=f'{what}; empty: the shipped one')


def extended(name: str, base: type | None, fields: dict) -> type:
    """Make a parameter class: ``base`` with more texts, numbers or lists of names."""
    return make_dataclass(
        name, [(key, NAMES if isinstance(entry.default, tuple) else
                str if entry.default is MISSING else type(entry.default), entry)
               for key, entry in fields.items()],
        bases=(base,) if base else (), kw_only=True,
        frozen=base is None or base.__dataclass_params__.frozen)


def declare(node: Node, cls: type, file: str | None = None, file_key: str | None = None,
            on_change: Callable | None = None, changeable: tuple[str, ...] = ()):
    """
    Declare every leaf of the parameter dataclass ``cls``; return its validated instance.

    Overrides of the command line (``--params-file``, ``-p``) precede the values of the file, and
    these precede the defaults of the class. ``file`` is the shipped one, the parameter
    ``file_key`` names another. Names that begin with one of ``changeable`` may be set in flight;
    ``on_change`` gets the new instance, and may raise ParameterError to refuse it.

    Raises:
        ParameterError: unusable value; names file, key and expectation.

    """
    overrides = {name: value.value for name, value in node._parameter_overrides.items()
                 if name not in ROS_OWN and not name.startswith(ROS_OWN_PREFIX)}
    start_from = overrides.get(file_key) or (share_path(file) if file else None)
    mapping = schema.load_yaml(start_from) if start_from else {}
    for name, value in overrides.items():
        _put(mapping, name, value)
    instance = schema.bind(cls, mapping)
    for name, entry, hint, value in schema.flatten(instance):
        if isinstance(value, (dict, tuple)) and hint != NAMES:
            continue    # structured values live in files only
        node.declare_parameter(name, _plain(value), _descriptor(
            entry, hint, not name.startswith(changeable)), ignore_override=True)
    if on_change:
        _validate_changes(node, cls, instance, on_change)
    return instance


def _put(mapping, name, value):
    *path, leaf = name.split('.')
    for part in path:
        level = mapping.setdefault(part, {})
        mapping = level if isinstance(level, dict) else mapping
    mapping[leaf] = value


def _plain(value):
    if isinstance(value, np.ndarray):
        return value.ravel().astype(float).tolist()
    if value is None:       # an optional number that is not set
        return float('nan')
    return list(value) if isinstance(value, tuple) else value


def _descriptor(entry, hint, fixed) -> ParameterDescriptor:
    meta = entry.metadata
    unit = f" [{meta['unit']}]" if meta.get('unit') else ''
    return ParameterDescriptor(
        description=meta.get('doc', '') + unit,
        # ROS gives an empty list another type, and [2] is a list of integers.
        dynamic_typing=hint is np.ndarray and meta.get('shape') is None or hint == NAMES,
        read_only=fixed,
        additional_constraints=f"one of {', '.join(meta['choices'])}" if meta.get('choices')
        else ' to '.join(f'{meta[end]:g}' for end in ('low', 'high')
                         if meta.get(end) is not None))


def _validate_changes(node, cls, instance, on_change):
    current = {name: value for name, _, _, value in schema.flatten(instance)}

    def changed(parameters):
        # ROS itself refuses read-only and unknown names.
        proposed = current | {each.name: each.value for each in parameters if each.name in current}
        try:
            new = schema.bind(cls, schema.nest(proposed), node.get_name())
            on_change(new)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        current.update(proposed)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(changed)
