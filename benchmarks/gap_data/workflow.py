"""
Runs the workflow that is judged, blind, and notes what it answered and what it cost.

It runs in a process of its own and is given paths of bags and of a robot file, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
import hashlib
import json
import math
import os
from pathlib import Path
import resource
import shlex
import subprocess
import sys
import tempfile
import time

HERE = Path(__file__).parent
VERDICTS = ('no_gap', 'named', 'named_set', 'unknown', 'not_decidable', 'bad_data')
KEYS = ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor', 'closure',
        'candidates', 'next_experiment')


class WorkflowError(ValueError):
    """A workflow that cannot be run as given."""


@dataclass(frozen=True)
class Workflow:
    """
    What is judged.

    Attributes:
        name: in tables.
        text: 'package.module:function', or a command in which ``{runs} {holdout} {robot} {apply}
            {json} {page}`` are replaced by paths.
        timeout: [s] for a case.
        version: of its code; answers of another one are not kept for this.

    """

    name: str
    text: str
    timeout: float = 300.0
    version: str = ''

    @classmethod
    def parse(cls, text: str, timeout: float = 300.0) -> Workflow:
        """From the command line: ``[NAME=]TEXT``."""
        name, mark, rest = text.partition('=')
        if not mark or not name.replace('_', '').isalnum():
            name, rest = 'gap', text
        if '{' not in rest and not rest.replace('.', '').replace(':', '').replace(
                '_', '').isalnum():
            raise WorkflowError(f"workflow '{text}': expected MODULE:FUNCTION, or a command with "
                                '{runs} and {json}')
        if '{' in rest and not ('{runs}' in rest and '{json}' in rest):
            raise WorkflowError(f"workflow '{text}': a command needs {{runs}} and {{json}}")
        return cls(name, rest, timeout)

    def key(self) -> str:
        """Folder name of its answers."""
        return f'{self.name}_{_digest(self.text + self.version)}'

    def arguments(self, case: Path, output: Path) -> list[str]:
        """The command for a case."""
        runs = [str(p) for p in sorted(case.glob('fit_*'))]
        held = [str(p) for p in sorted(case.glob('holdout_*'))]
        paths = {'robot': str(case / 'robot.yaml'), 'apply': str(output / 'robot_new.yaml'),
                 'json': str(output / 'gap.json'), 'page': str(output / 'gap.html')}
        if '{' in self.text:
            lists = {'runs': shlex.join(runs), 'holdout': shlex.join(held)}
            return shlex.split(self.text.format(**lists, **{k: shlex.quote(v)
                                                            for k, v in paths.items()}))
        return [sys.executable, '-m', 'gap_data.entry', self.text, *runs, '--holdout', *held,
                *(word for key, path in paths.items() for word in (f'--{key}', path))]


def _digest(text):
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def run_workflow(workflow: Workflow, case: Path) -> dict:
    """
    Run it on one case.

    Returns:
        ``answer`` (the JSON, or None), ``problems`` of the JSON, ``status``, ``wall_s``,
        ``cpu_s``, ``traceback`` (bool), ``message`` (end of standard error).

    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.monotonic()
    # beside the case, not in the temporary folder: a worker may be killed
    with tempfile.TemporaryDirectory(prefix='.gap_', dir=case.parent) as folder:
        output = Path(folder)
        try:
            done = subprocess.run(
                workflow.arguments(case, output), cwd=output, capture_output=True, text=True,
                errors='replace', check=False, timeout=workflow.timeout, env=_environment())
            status, text = done.returncode, done.stderr
            printed = done.stdout + done.stderr
        except subprocess.TimeoutExpired:
            status, text, printed = 124, f'not finished after {workflow.timeout:g} s', ''
        wall = time.monotonic() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        answer, problems = read_answer(output / 'gap.json')
    cpu = (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)
    return {'answer': answer, 'problems': problems, 'status': status, 'wall_s': wall,
            'cpu_s': cpu, 'traceback': 'Traceback (most recent call last)' in printed,
            'message': text.strip()[-600:]}


def _environment():
    """This process's, with this folder and the current one importable in the child."""
    paths = [str(HERE.parent), os.getcwd(), *os.environ.get('PYTHONPATH', '').split(os.pathsep)]
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(p for p in paths if p),
            'NO_COLOR': '1'}


def read_answer(path: Path) -> tuple[dict | None, list[str]]:
    """The JSON and what is wrong with it after the interface."""
    try:
        answer = json.loads(path.read_text())
    except OSError:
        return None, ['no JSON']
    except ValueError as error:
        return None, [f'not JSON: {error}']
    if not isinstance(answer, dict):
        return None, ['not an object']
    problems = [f'no key {key}' for key in KEYS if key not in answer]
    if answer.get('verdict') not in VERDICTS:
        problems.append(f'verdict {answer.get("verdict")!r}')
    effects = answer.get('effects')
    if not isinstance(effects, list):
        problems.append('effects is no list')
        answer['effects'] = effects = []
    for effect in effects:
        if not isinstance(effect, dict) or not isinstance(effect.get('names'), list):
            problems.append('an effect without names')
            continue
        for name, entry in (effect.get('parameters') or {}).items():
            if not isinstance(entry, dict) or 'value' not in entry:
                problems.append(f'{name} without value')
            elif 'interval' not in entry or 'unit' not in entry:
                problems.append(f'{name} without interval or unit')
    answer['effects'] = [e for e in effects
                         if isinstance(e, dict) and isinstance(e.get('names'), list)]
    for key in ('gap_before', 'gap_after', 'noise_floor', 'closure'):
        value = answer.get(key)
        if value is not None and not (isinstance(value, (int, float)) and math.isfinite(value)):
            problems.append(f'{key} is {value!r}')
            answer[key] = None
    return answer, problems
