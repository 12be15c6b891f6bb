"""One thing looked at: how it is, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace

from beetle_omni_ros.bringup.heard import BRIDGES, Heard

OK, WARN, FAIL = 'ok', 'warn', 'fail'
LEVELS = (OK, WARN, FAIL)


@dataclass(frozen=True, slots=True)
class Finding:
    """
    One row of the result.

    Attributes:
        item: what was looked at; stable, for scripts.
        level: 'ok', 'warn' (flies, but look at it) or 'fail'.
        found: in words and numbers with units.
        remedy: what to do; '' where all is well.
        values: numbers behind ``found``, the unit in the key's ending.

    """

    item: str
    level: str
    found: str
    remedy: str = ''
    values: Mapping[str, float | int | str | None] = field(default_factory=dict)

    def as_dict(self, part: str) -> dict:
        """Row of the JSON."""
        return {'part': part, **asdict(self), 'values': dict(self.values)}


def worst(levels: Iterable[str]) -> str:
    """Return the worst of some levels; 'ok' of none."""
    return max(levels, key=LEVELS.index, default=OK)


def graded(item: str, found: str, value: float, remedy: str, *, warn: float, fail: float,
           values: Mapping | None = None) -> Finding:
    """Judge a number that is better the smaller it is: above ``warn``, above ``fail``."""
    level = FAIL if not value <= fail else WARN if value > warn else OK
    return Finding(item, level, found, '' if level == OK else remedy, values or {})


def missing_library(item: str, error: ModuleNotFoundError, extra: str) -> Finding:
    """Say which extra of pip brings a library that is not installed."""
    module = (error.name or '').partition('.')[0]
    return Finding(item, FAIL, f"not looked at: the module '{module}' is not installed",
                   f"pip install 'beetle_omni_ros[{extra}]'")


OF_DIAGNOSTICS = {0: OK, 1: WARN}       # errors and stale ones fail
FAULTS = {'joint_bridge': 'docs/reference/hardware_faults.md: what happens when',
          'rotor_bridge': 'docs/reference/firmware.md: outcome of faults'}
UNUSED = ('node', 'inputs', 'compute')  # of every node; the topics themselves are judged


def bridge_findings(port: Finding, bridge: str, heard: Heard | None) -> list[Finding]:
    """
    Findings about a device whose port cannot be opened here.

    Args:
        port: the failed finding about the port.
        bridge: 'joint_bridge' or 'rotor_bridge'.
        heard: None where nobody listened.

    """
    busy = bool(port.values.get('holders')) or 'another process' in port.found
    if not (busy and heard and heard.runs(bridge)):
        return [port]
    port = replace(port, level=OK, remedy='', found=f'{port.found}; not opened, judged by '
                   f'what {bridge}_node reports of {BRIDGES[bridge]}')
    return [port, *reported(bridge, heard)]


def reported(bridge: str, heard: Heard) -> list[Finding]:
    """State and diagnostics of a running bridge as findings."""
    findings = [_of_state(bridge, heard.states.get(bridge))]
    for name, status in heard.of_bridge(bridge).items():
        if name in UNUSED:
            continue
        level = OF_DIAGNOSTICS.get(status.level, FAIL)
        findings.append(Finding(f'{bridge} {name}', level, status.message or 'no message',
                                '' if level == OK else FAULTS[bridge],
                                status.values))
    if len(findings) == 1:
        findings.append(Finding(f'{bridge} diagnostics', WARN, f'none within {heard.seconds:g} s',
                                'listen longer: --seconds 5'))
    return findings


def _of_state(bridge, state):
    item = f'{bridge} state'
    if state is None:
        return Finding(item, WARN, f'no {bridge}/state', 'a bridge of another version?')
    if state == 'ready':
        return Finding(item, OK, state)
    if state.startswith('waiting'):
        return Finding(item, WARN, state, f'configure and activate {bridge}_node, or cure '
                       'what it waits for')
    return Finding(item, FAIL, state, 'cure it, then disarm and arm again')
