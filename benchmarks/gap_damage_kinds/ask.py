"""Run the gap finder on bags, in its own process."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
import subprocess
import sys
import time

CALL = 'import sys; from beetle_omni_ros.cli import main; sys.exit(main())'
TIMEOUT = 124       # exit status, as of timeout(1)
PACKAGE = Path(__file__).resolve().parents[2]


def ask(fitted: list[Path], judging: Path, output: Path, timeout: float) -> dict:
    """
    Run `beetle_omni gap`.

    Args:
        fitted: fitted bags.
        judging: held-out bag.
        output: file for the JSON.
        timeout: largest time [s].

    Returns:
        ``status`` (124 after the timeout), ``answer`` (JSON or None), ``seconds``, ``crash``
        (a traceback was printed), ``message`` (the end of standard error), ``folder``.

    """
    words = [sys.executable, '-c', CALL, 'gap', *map(str, fitted), '--holdout', str(judging),
             '--json', str(output)]
    began = time.monotonic()
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors='replace',
                              check=False, timeout=timeout, env=_environment())
        status, text = done.returncode, done.stderr
    except subprocess.TimeoutExpired:
        status, text = TIMEOUT, f'not finished after {timeout:g} s'
    seconds = time.monotonic() - began
    try:
        answer = json.loads(output.read_text())
    except (OSError, ValueError):
        answer = None
    return {'status': status, 'answer': answer, 'seconds': seconds,
            'folder': str(output.parent), 'crash': 'Traceback' in text,
            'message': text.strip()[-600:]}


def kept(file: Path, key: str) -> dict | None:
    """A kept answer to the same question, or None."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError):
        return None
    return found['result'] if found.get('key') == key else None


def keep(file: Path, key: str, result: dict) -> None:
    """Keep an answer."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({'key': key, 'result': result}) + '\n')


def code_key() -> str:
    """Hash of the package's code and parameters, on which answers depend."""
    digest = hashlib.sha256()
    for folder in (PACKAGE / 'beetle_omni_ros', PACKAGE / 'params'):
        for file in sorted(folder.rglob('*')):
            if file.suffix in ('.py', '.yaml'):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _environment():
    """Environment of this process, with the package of this tree first."""
    paths = [str(PACKAGE), *os.environ.get('PYTHONPATH', '').split(os.pathsep)]
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(p for p in paths if p), 'NO_COLOR': '1',
            'OMP_NUM_THREADS': os.environ.get('OMP_NUM_THREADS', '1')}
