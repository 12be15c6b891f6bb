"""Makes flights, lets workflows answer, keeps both, judges at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import hashlib
import json
import os
from pathlib import Path

import joblib

from gap_data.cases import Case, load_settings
from gap_data.flight import LostFlight
from gap_data.judge import judge
from gap_data.make import make_case, ROBOT_FILE
from gap_data.score import score
from gap_data.workflow import run_workflow, Workflow

# (case, workflow's name or 'flights', judged or None, kept)
Report = Callable[[Case, str, dict | None, bool], None]


def run_campaign(cases: list[Case], workflows: list[Workflow], folder: Path, *,
                 sealed: Path | None = None, robot_file: Path = ROBOT_FILE, fresh: bool = False,
                 done: Report = lambda *_: None) -> dict[str, list[dict]]:
    """
    Run every workflow on every case, in joblib's configuration of the moment.

    Args:
        cases: which.
        workflows: which; none makes the flights only.
        folder: of flights and answers.
        sealed: of the labels; None is 'sealed' in ``folder``.
        robot_file: what the workflows are told.
        fresh: ask again where an answer is kept.
        done: called as results come in.

    Returns:
        Workflow's name -> judged cases in the order given; lost flights are left out.

    """
    sealed = sealed or folder / 'sealed'
    order = {case.key(): k for k, case in enumerate(cases)}
    judged: dict[str, dict[int, dict]] = {w.name: {} for w in workflows}
    calls = (joblib.delayed(_one)(case, workflows, folder, sealed, robot_file, fresh)
             for case in cases)
    for case, results in _unordered(calls):
        if results is None:
            done(case, 'flights', None, False)
            continue
        label = open_label(case, sealed)
        for workflow in workflows:
            run, kept = results[workflow.name]
            result = judged[workflow.name][order[case.key()]] = judge(label, run)
            done(case, workflow.name, result, kept)
        if not workflows:
            done(case, 'flights', None, False)
    return {name: [found[k] for k in sorted(found)] for name, found in judged.items()}


def open_label(case: Case, sealed: Path) -> dict:
    """A sealed label, with what counts as right beside the hidden effects."""
    label = json.loads((sealed / f'{case.key()}.json').read_text())
    hover = (load_settings()['undecidable'].get(case.effects[0][0])
             if case.kind == 'undecidable' else None)
    return {**label, 'allowed': case.allowed(), 'accept': case.accept(),
            'sets': hover['set'] if hover else [],
            'name_is_right': bool(hover and hover['name_is_right'])}


def _unordered(calls) -> Iterator:
    parallel = joblib.Parallel(return_as='generator_unordered', batch_size=1, pre_dispatch='all')
    yield from parallel(calls)


def _one(case, workflows, folder, sealed, robot_file, fresh):
    """Runs in a worker."""
    try:
        flights = make_case(case, folder / 'flights', sealed, robot_file)
    except LostFlight:
        return case, None
    results = {}
    for workflow in workflows:
        path = folder / 'answers' / f'{workflow.key()}' / f'{case.key()}.json'
        if path.is_file() and not fresh:
            results[workflow.name] = json.loads(path.read_text()), True
            continue
        run = run_workflow(workflow, flights)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f'{path.name}.{os.getpid()}')
        partial.write_text(json.dumps(run))
        os.replace(partial, path)
        results[workflow.name] = run, False
    return case, results


def make_report(judged: dict[str, list[dict]], meta: dict) -> dict:
    """Everything in one JSON: scores and, for each case, what was judged."""
    return {'meta': meta,
            'workflows': {name: score(rows) for name, rows in judged.items()},
            'cases': judged}


def code_key(paths: list[Path]) -> str:
    """Of Python files below the paths: answers of other code are not the same answers."""
    digest = hashlib.sha256()
    for path in sorted(p for root in paths for p in root.rglob('*.py')):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]
