"""
Detection of damaged recordings by `beetle_omni gap`: ``python benchmarks/gap_damage.py``.

Undamaged flights are made in this process and kept. Each kind of damage (``gap_damage_kinds``) is
applied to their bags, message by message, and the gap finder runs on them. Damaged data must never
result in no gap or in an effect, and the cause must be stated.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import hashlib
import os
from pathlib import Path
import shlex
import shutil
import sys

import joblib
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

HERE = Path(__file__).resolve().parent
PLACES = [str(HERE), str(HERE.parent)]
sys.path[:0] = [place for place in PLACES if place not in sys.path]

from gap_damage_kinds import ask, report  # noqa: E402
from gap_damage_kinds.catalogue import KINDS  # noqa: E402
from gap_damage_kinds.flights import FLIGHTS, make_flight, sets_of, undamaged  # noqa: E402
from gap_damage_kinds.judge import judge, verdict_of  # noqa: E402
from gap_damage_kinds.kind import FIRST  # noqa: E402
from gap_damage_kinds.recording import MEASURED, Recording  # noqa: E402


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split('\n\n')[0])
    parser.add_argument('--kinds', help='only these, separated by commas')
    parser.add_argument('--list', action='store_true', help='print the kinds and end')
    parser.add_argument('--flights', type=int, default=3, metavar='K',
                        help='sets of three flights (%(default)s)')
    parser.add_argument('--runs', type=Path, nargs='+', metavar='DIR', default=[],
                        help='bags in place of own flights: two fitted, one that judges, again')
    parser.add_argument('--undamaged', type=int, metavar='N',
                        help='only load N undamaged flights, and count the refused')
    parser.add_argument('--everywhere', action='store_true',
                        help='damage all flights of a set, also by what happens once')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--folder', type=Path, default=Path('runs_out/gap_damage'),
                        help='where flights are kept (%(default)s)')
    parser.add_argument('--output', type=Path, help='for damage.json and damage.md (FOLDER)')
    parser.add_argument('--jobs', type=int, default=1, help='at a time; -1: every core')
    parser.add_argument('--timeout', type=float, default=300.0, metavar='S', help='of an answer')
    parser.add_argument('--fresh', action='store_true', help='ask again where an answer is kept')
    parser.add_argument('--keep', action='store_true', help='keep the damaged bags')
    given = parser.parse_args(arguments)
    names = given.kinds.split(',') if given.kinds else list(KINDS)
    if unknown := [name for name in names if name not in KINDS]:
        parser.error(f"unknown kind {', '.join(unknown)}; see --list")
    if given.undamaged is None and len(given.runs) % FLIGHTS:
        parser.error(f'--runs: {len(given.runs)} bags, expected two fitted and one that judges')
    given.names = names
    return given


def on_cores(text: str, jobs: int, calls: list[tuple], console: Console):
    """Yield numbered results of (function, arguments...) as they finish, with a progress bar."""
    def numbered(k, function, *arguments):
        return k, function(*arguments)

    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        bar = bars.add_task(text, total=len(calls))
        for k, result in joblib.Parallel(n_jobs=jobs, return_as='generator_unordered')(
                joblib.delayed(numbered)(k, *call) for k, call in enumerate(calls)):
            bars.advance(bar)
            yield k, result


def fly_all(orders: list, jobs: int, console: Console) -> list[Path]:
    """Make missing flights; return their bags in order."""
    for k, ended in on_cores('flights', jobs, [(make_flight, order) for order in orders],
                             console):
        if ended:
            console.print(f'{orders[k].folder}: {ended}', style='yellow', highlight=False)
    return [order.folder / 'bag' for order in orders]


@dataclass(frozen=True)
class Case:
    """
    One test case.

    Attributes:
        name: kind of damage; None: undamaged flights.
        bags: two fitted bags and the held-out one.
        other: bag of another flight.
        seed: seed of the damage.
        everywhere: whether all flights are damaged, whatever the scope of the kind.
        place: folder of the damaged bags, with a neutral name.
        timeout: largest time of the analysis [s].
        keep: whether the damaged bags are kept.

    """

    name: str | None
    bags: tuple[Path, ...]
    other: Path
    seed: int
    everywhere: bool
    place: Path
    timeout: float
    keep: bool

    def key(self, code: str) -> str:
        """Key of a kept answer."""
        damage = KINDS[self.name].key() if self.name else ''
        bags = ' '.join(str(bag) for bag in (*self.bags, self.other))
        return f'{code} {self.name} {damage} {self.seed} {self.everywhere} {bags}'


def answered(case: Case, code: str, fresh: bool) -> dict:
    """
    The answer to a case, from the kept ones if possible.

    Returns:
        see :func:`~gap_damage_kinds.ask.ask`, with ``onset`` [s] in the first flight or None, and
        ``begin``, the first stamp of that flight [s].

    """
    file = case.place.with_suffix('.json')
    found = None if fresh else ask.kept(file, case.key(code))
    if found is None:
        found = ask_damaged(case)
        if found['status'] != ask.TIMEOUT:     # on a busy computer a timeout proves little
            ask.keep(file, case.key(code), found)
    return found


def ask_damaged(case: Case) -> dict:
    """Damage a set of flights, analyse it, and clean up; see :func:`answered`."""
    shutil.rmtree(case.place, ignore_errors=True)
    case.place.mkdir(parents=True)
    other, onset, begin, paths = Recording.read(case.other), None, 0.0, []
    for n, bag in enumerate(case.bags):
        recording = Recording.read(bag)
        if n == 0:
            begin = min(recording.on(topic)[0].stamp for topic in MEASURED)
        if case.name and (n == 0 or case.everywhere or KINDS[case.name].scope != FIRST):
            recording, moment = KINDS[case.name].apply(recording, other, case.seed + n)
            onset = moment if n == 0 else onset
        paths.append(recording.write(case.place / f'flight_{n}'))
    found = ask.ask(paths[:-1], paths[-1], case.place / 'gap.json', case.timeout)
    if not case.keep:
        shutil.rmtree(case.place)
    return {**found, 'onset': onset, 'begin': begin}


def flight_sets(given: argparse.Namespace, console: Console) -> list[list[Path]]:
    """Sets of bags: two fitted ones and a held-out one."""
    if given.runs:
        return [given.runs[k:k + FLIGHTS] for k in range(0, len(given.runs), FLIGHTS)]
    orders = [o for s in sets_of(given.folder / 'flights', given.flights, given.seed) for o in s]
    bags = fly_all(orders, given.jobs, console)
    return [bags[k:k + FLIGHTS] for k in range(0, len(bags), FLIGHTS)]


def run_kinds(given: argparse.Namespace, console: Console) -> int:
    """Analyse every kind of damage on every set; write tables and files."""
    sets, code = flight_sets(given, console), ask.code_key()
    cases = [Case(name, tuple(sets[k]), sets[(k + 1) % len(sets)][1], given.seed,
                  given.everywhere, place_of(given.folder, name, k), given.timeout, given.keep)
             for name in (None, *given.names) for k in range(len(sets))]
    calls, done = [(answered, case, code, given.fresh) for case in cases], {}
    for n, asked in on_cores('asked', given.jobs, calls, console):
        done[n] = asked
        console.print(f'{cases[n].name or "undamaged"}, set {n % len(sets) + 1}: '
                      f'{verdict_of(asked)}', highlight=False)
    found = {name: [done[n] for n, case in enumerate(cases) if case.name == name]
             for name in (None, *given.names)}
    known = [named(asked) for asked in found[None]]
    for k, asked in enumerate(found[None]):
        console.print(f'undamaged set {k + 1}: {verdict_of(asked)} {", ".join(known[k])}',
                      highlight=False)
    results = {name: [judge(KINDS[name], asked, names)
                      for asked, names in zip(found[name], known, strict=True)]
               for name in given.names}
    output = given.output or given.folder
    report.write(results, KINDS, {'command': command_of(given), 'undamaged': known}, output)
    report.show(results, KINDS, console)
    print(f'{output}/damage.json, damage.md')
    return 0 if all(j.right for row in results.values() for j in row) else 1


def place_of(folder: Path, name: str | None, k: int) -> Path:
    """Folder of a case, with a neutral name."""
    return folder / 'asked' / hashlib.sha256(f'{name} {k}'.encode()).hexdigest()[:8]


def named(asked: dict) -> tuple[str, ...]:
    """All effects named in undamaged flights."""
    effects = (asked['answer'] or {}).get('effects') or ()
    return tuple(name for effect in effects for name in effect['names'])


def check(bag: Path) -> str:
    """Load a flight like the gap finder; return the reason of a refusal, or ''."""
    from beetle_omni_ros.identify.gap.bags import BagError
    from beetle_omni_ros.identify.gap.ingest import load_flight, UnusableFlight
    from beetle_omni_ros.identify.gap.parameters import GapParameters
    from beetle_omni_ros.robot.parameters import RobotParameters
    try:
        load_flight(bag, RobotParameters.load(), GapParameters.load())
    except (BagError, UnusableFlight) as error:
        return str(error)
    return ''


def run_undamaged(given: argparse.Namespace, console: Console) -> int:
    """Load undamaged flights; print refused ones."""
    orders = undamaged(given.folder / 'undamaged', given.undamaged, given.seed)
    bags = fly_all(orders, given.jobs, console) + given.runs
    refused = {}
    for k, reason in on_cores('checked', given.jobs, [(check, bag) for bag in bags], console):
        if reason:
            refused[str(bags[k])] = reason
            console.print(f'{bags[k]}: {reason}', style='red', highlight=False, markup=False)
    console.print(f'{len(refused)} of {len(bags)} undamaged flights refused', highlight=False)
    return 1 if refused else 0


def command_of(given: argparse.Namespace) -> str:
    """Command that reproduces the numbers."""
    words = ['python', 'benchmarks/gap_damage.py', '--flights', str(given.flights), '--seed',
             str(given.seed)]
    words += ['--kinds', given.kinds] if given.kinds else []
    words += ['--everywhere'] if given.everywhere else []
    return shlex.join(words)


def main(arguments: list[str] | None = None) -> int:
    """Analyse damaged flights, or load undamaged ones."""
    given = parse(arguments)
    if given.list:
        for kind in KINDS.values():
            print(f'{kind.name:28} {kind.harm:10} {kind.scope:6} {kind.description}')
        return 0
    before = os.environ.get('PYTHONPATH', '').split(os.pathsep)     # for the workers
    os.environ['PYTHONPATH'] = os.pathsep.join(filter(None, [*PLACES, *before]))
    console = Console(stderr=True)
    if given.undamaged is not None:
        return run_undamaged(given, console)
    return run_kinds(given, console)


if __name__ == '__main__':
    sys.exit(main())
