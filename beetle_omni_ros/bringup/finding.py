"""Findings: what a check found about one item, and the remedy."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

from beetle_omni_ros.bringup.graph import BRIDGES, ObservedGraph

OK, WARN, FAIL = 'ok', 'warn', 'fail'


@dataclass(frozen=True, slots=True)
class Finding:
    """
    One row of the result.

    Attributes:
        item: name of the checked item, stable for scripts.
        level: 'ok', 'warn' (the robot can fly, but look at the item) or 'fail'.
        found: description with numbers and units.
        remedy: what to do; '' for level 'ok'.
        values: numbers behind ``found``; each key ends with the unit.

    """

    item: str
    level: str
    found: str
    remedy: str = ''
    values: Mapping[str, float | int | str | None] = field(default_factory=dict)

    def as_dict(self, part: str) -> dict:
        """Row of the JSON."""
        return {'part': part, **asdict(self), 'values': dict(self.values)}


def graded(item: str, found: str, value: float, remedy: str, *, warn: float, fail: float,
           values: Mapping | None = None) -> Finding:
    """Finding about ``value``: 'warn' above ``warn``, 'fail' above ``fail`` or for NaN."""
    level = FAIL if not value <= fail else WARN if value > warn else OK
    return Finding(item, level, found, '' if level == OK else remedy, values or {})


def missing_library(item: str, error: ModuleNotFoundError, extra: str) -> Finding:
    """Finding about an item that needs a library of the pip extra ``extra``."""
    module = (error.name or '').partition('.')[0]
    return Finding(item, FAIL, f"not checked: the module '{module}' is not installed",
                   f"pip install 'beetle_omni_ros[{extra}]'")


DIAGNOSTIC_LEVELS = {0: OK, 1: WARN}        # error and stale are failures
FAULT_PAGES = {'joint_bridge': 'docs/reference/hardware_faults.md: what happens when',
               'rotor_bridge': 'docs/reference/firmware.md: outcome of faults'}
UNUSED = ('node', 'inputs', 'compute')      # statuses of every node; check_topics covers them


def bridge_findings(port: Finding, bridge: str, graph: ObservedGraph | None) -> list[Finding]:
    """
    Findings about a device whose port cannot be opened, with the failed finding ``port``.

    If ``bridge`` runs and has the port open, its reports replace the failure.
    """
    busy = bool(port.values.get('holders')) or 'another process' in port.found
    if not (busy and graph and graph.runs(bridge)):
        return [port]
    port = replace(port, level=OK, remedy='', found=f'{port.found}; not opened, judged by '
                   f'what {bridge}_node reports about {BRIDGES[bridge]}')
    return [port, *reported(bridge, graph)]


def reported(bridge: str, graph: ObservedGraph) -> list[Finding]:
    """State and diagnostics of a running bridge as findings."""
    findings = [_of_state(bridge, graph.states.get(bridge))]
    for name, status in graph.of_bridge(bridge).items():
        if name in UNUSED:
            continue
        level = DIAGNOSTIC_LEVELS.get(status.level, FAIL)
        findings.append(Finding(f'{bridge} {name}', level, status.message or 'no message',
                                '' if level == OK else FAULT_PAGES[bridge], status.values))
    if len(findings) == 1:
        findings.append(Finding(f'{bridge} diagnostics', WARN, f'none within {graph.seconds:g} s',
                                'increase the time: --seconds 5'))
    return findings


def _of_state(bridge, state):
    item = f'{bridge} state'
    if state is None:
        return Finding(item, WARN, f'no {bridge}/state', 'check the version of the bridge')
    if state == 'ready':
        return Finding(item, OK, state)
    if state.startswith('waiting'):
        return Finding(item, WARN, state, f'configure and activate {bridge}_node, or remove '
                       'the stated cause')
    return Finding(item, FAIL, state, 'remove the cause, then disarm and arm again')
