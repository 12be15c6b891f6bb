"""Subcommand controllers: which there are."""

from __future__ import annotations

from beetle_omni_ros.cli.options import JsonOption
from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import ParameterError


def controllers(json_path: JsonOption = None):
    """
    List the registered controllers.

    Others fly as package.module:Class or path/to/file.py:Class, see docs/how-to/own_controller.md.
    Example: beetle_omni controllers --json controllers.json
    """
    from rich.console import Console
    from rich.table import Table

    from beetle_omni_ros.runs.json_file import check_writable, write_json
    if json_path:
        check_writable(json_path)
    found = {name: _known(name) for name in registry.names()}
    table = Table(box=None, header_style='dim', padding=(0, 2, 0, 0))
    for column in ('name', 'what', 'rate [Hz]', 'parameters', 'policy', 'actuators lost',
                   'guidance'):
        table.add_column(column)
    for name, known in found.items():
        if 'error' in known:
            table.add_row(name, known['error'])
            continue
        table.add_row(name, known['description'], f"{known['rate_hz']:g}",
                      known['parameters_file'] or '–', known['policy_file'] or '–',
                      'flies' if known['flies_degraded'] else '–', known['guidance'])
    Console().print(table)
    if json_path:
        write_json(json_path, found)


def _known(name):
    """What is told of a controller; of one that cannot be loaded, why."""
    try:
        entry = registry.find(name)
    except ParameterError as error:
        return {'error': str(error)}
    return {'description': entry.description, 'rate_hz': 1 / entry.period,
            **{key: getattr(entry, key) for key in (
                'parameters_file', 'policy_file', 'flies_degraded', 'guidance', 'stands_by')}}
