"""Makes flights, lets `beetle_omni gap` answer blind, keeps both, judges at the end."""

from __future__ import annotations

from collections.abc import Callable
import hashlib
import json
import os
from pathlib import Path
import resource
import shlex
import subprocess
import tempfile
import time

import joblib

from gap_data.cases import Case, load_settings
from gap_data.flight import LostFlight
from gap_data.judge import judge
from gap_data.make import make_case, ROBOT_FILE

KEYS = ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor', 'closure',
        'candidates', 'next_experiment')


def run_campaign(cases: list[Case], tool: str, folder: Path, *, version: str = '',
                 sealed: Path | None = None, robot_file: Path = ROBOT_FILE, fresh: bool = False,
                 timeout: float = 300.0,
                 done: Callable[[Case, dict | None], None] = lambda *_: None) -> list[dict]:
    """
    Ask the tool about every case, in joblib's configuration of the moment.

    Args:
        cases: which.
        tool: command that takes `gap` and its arguments; '' makes the flights only.
        folder: of flights and answers.
        version: of the tool's code; answers of another one are not kept for this.
        sealed: of the labels; None is 'sealed' in ``folder``.
        robot_file: what the tool is told.
        fresh: ask again where an answer is kept.
        timeout: [s] for a case.
        done: called with what was judged, as results come in.

    Returns:
        Judged cases in the order given; lost flights are left out.

    """
    sealed = sealed or folder / 'sealed'
    place = hashlib.sha256((tool + version).encode()).hexdigest()[:8]
    calls = (joblib.delayed(_one)(case, tool, folder, sealed, robot_file, timeout,
                                  folder / 'answers' / place / f'{case.key()}.json', fresh)
             for case in cases)
    judged = {}
    for case, run in joblib.Parallel(return_as='generator_unordered', batch_size=1,
                                     pre_dispatch='all')(calls):
        if run:
            judged[case.key()] = judge(open_label(case, sealed), run)
        done(case, judged.get(case.key()))
    return [judged[case.key()] for case in cases if case.key() in judged]


def open_label(case: Case, sealed: Path) -> dict:
    """A sealed label, with what counts as right beside the hidden effects."""
    label = json.loads((sealed / f'{case.key()}.json').read_text())
    hover = (load_settings()['undecidable'].get(case.effects[0][0])
             if case.kind == 'undecidable' else None)
    return {**label, 'allowed': case.allowed(), 'accept': case.accept(),
            'sets': hover['set'] if hover else [],
            'name_is_right': bool(hover and hover['name_is_right'])}


def _one(case, tool, folder, sealed, robot_file, timeout, kept, fresh):
    """Runs in a worker."""
    try:
        flights = make_case(case, folder / 'flights', sealed, robot_file)
    except LostFlight:
        return case, None
    if not tool:
        return case, None
    if kept.is_file() and not fresh:
        return case, json.loads(kept.read_text())
    run = ask(tool, flights, timeout)
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_name(f'{kept.name}.{os.getpid()}')
    partial.write_text(json.dumps(run))
    os.replace(partial, kept)
    return case, run


def ask(tool: str, case: Path, timeout: float) -> dict:
    """
    Run the tool on one case, in a process of its own that is told paths and nothing else.

    Returns:
        ``answer`` (the JSON, or None), ``problems`` of the JSON, ``status``, ``wall_s``,
        ``cpu_s``, ``traceback`` (bool), ``message`` (end of standard error).

    """
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    # beside the case, not in the temporary folder: a worker may be killed
    with tempfile.TemporaryDirectory(prefix='.gap_', dir=case.parent) as folder:
        words = [*shlex.split(tool), 'gap', *map(str, sorted(case.glob('fit_*'))), '--holdout',
                 *map(str, sorted(case.glob('holdout_*'))), '--robot', str(case / 'robot.yaml'),
                 '--apply', 'robot_new.yaml', '--json', 'gap.json', '--report', 'gap.html']
        try:
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True,
                                  errors='replace', check=False, timeout=timeout,
                                  env={**os.environ, 'NO_COLOR': '1'})
            status, text, printed = done.returncode, done.stderr, done.stdout + done.stderr
        except subprocess.TimeoutExpired:
            status, text, printed = 124, f'not finished after {timeout:g} s', ''
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        answer, problems = read_answer(Path(folder, 'gap.json'))
    return {'answer': answer, 'problems': problems, 'status': status,
            'wall_s': time.monotonic() - began,
            'cpu_s': after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            'traceback': 'Traceback (most recent call last)' in printed,
            'message': text.strip()[-600:]}


def read_answer(path: Path) -> tuple[dict | None, list[str]]:
    """The JSON, and what is wrong with it after the interface."""
    try:
        answer = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        return None, [f'no JSON: {error}']
    problems = [f'no key {key}' for key in KEYS if key not in answer]
    problems += [f'{name} without {key}' for effect in answer['effects']
                 for name, entry in effect['parameters'].items()
                 for key in ('value', 'unit', 'interval') if key not in entry]
    return answer, problems


def code_key(paths: list[Path]) -> str:
    """Of Python files below the paths: answers of other code are not the same answers."""
    digest = hashlib.sha256()
    for path in sorted(p for root in paths for p in root.rglob('*.py')):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]
