"""Makes flights, lets `beetle_omni gap` answer blind, keeps both, judges at the end."""

from collections.abc import Iterator
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
from gap_data.make import make_case, write_json

KEYS = ('verdict', 'effects', 'where', 'gap_before', 'gap_after', 'noise_floor', 'closure',
        'candidates', 'next_experiment')
TIMEOUT = 300.0     # [s] for a case


def run_campaign(cases: list[Case], tool: str, folder: Path, *,
                 version: str = '') -> Iterator[dict | None]:
    """
    Ask the tool about every case, in joblib's configuration of the moment.

    Args:
        cases: which.
        tool: command that takes `gap` and its arguments.
        folder: of flights, labels and answers.
        version: of the tool's code; answers of another one are not kept for this.

    Yields:
        Judged cases in the order given; None for one whose flights are lost.

    """
    place = folder / 'answers' / hashlib.sha256((tool + version).encode()).hexdigest()[:8]
    runs = joblib.Parallel(return_as='generator', batch_size=1, pre_dispatch='all')(
        joblib.delayed(_one)(case, tool, folder, place / f'{case.key()}.json') for case in cases)
    for case, run in zip(cases, runs, strict=True):
        yield judge(open_label(case, folder / 'sealed'), run) if run else None


def open_label(case: Case, sealed: Path) -> dict:
    """A sealed label, with what counts as right beside the hidden effects."""
    label = json.loads((sealed / f'{case.key()}.json').read_text())
    hover = (load_settings()['undecidable'].get(case.effects[0][0])
             if case.kind == 'undecidable' else None)
    return {**label, 'allowed': case.allowed(), 'accept': case.accept(),
            'sets': hover['set'] if hover else [],
            'name_is_right': bool(hover and hover['name_is_right'])}


def _one(case, tool, folder, kept):
    """Runs in a worker."""
    try:
        flights = make_case(case, folder / 'flights', folder / 'sealed')
    except LostFlight:
        return None
    if kept.is_file():
        return json.loads(kept.read_text())
    run = ask(tool, flights)
    kept.parent.mkdir(parents=True, exist_ok=True)
    write_json(kept, run)
    return run


def ask(tool: str, case: Path) -> dict:
    """
    Run the tool on one case, in a process of its own that is told paths and nothing else.

    Returns:
        ``answer`` (the JSON, or None), ``problems`` of the JSON, ``wall_s``, ``cpu_s``,
        ``traceback`` (bool), ``message`` (end of standard error).

    """
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    # beside the case, not in the temporary folder: a worker may be killed
    with tempfile.TemporaryDirectory(prefix='.gap_', dir=case.parent) as folder:
        words = [*shlex.split(tool), 'gap', *map(str, sorted(case.glob('fit_*'))), '--holdout',
                 *map(str, sorted(case.glob('holdout_*'))), '--robot', str(case / 'robot.yaml'),
                 '--apply', 'robot_new.yaml', '--json', 'gap.json', '--report', 'gap.html']
        try:
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True,
                                  errors='replace', check=False, timeout=TIMEOUT,
                                  env={**os.environ, 'NO_COLOR': '1'})
            message, printed = done.stderr, done.stdout + done.stderr
        except subprocess.TimeoutExpired:
            message, printed = f'not finished after {TIMEOUT:g} s', ''
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        answer, problems = read_answer(Path(folder, 'gap.json'))
    return {'answer': answer, 'problems': problems, 'wall_s': time.monotonic() - began,
            'cpu_s': after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            'traceback': 'Traceback (most recent call last)' in printed,
            'message': message.strip()[-200:]}


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
