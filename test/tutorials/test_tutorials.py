"""
Each tutorial runs from its text: its files are written, its commands run in one folder.

A comment before a block states a difference between the test and a reader:
``<!-- test: skip -->``, ``OLD -> NEW`` in the commands, ``prints TEXT``, ``fails STATUS``,
``background NAME`` until a block that ``ends NAME`` or the page's end, and ``waits FILE`` for a
file of that program.

A block without a language shows lines that the command before it prints, so the test runs this
command unchanged. Each number in the text of a page is in one of its blocks.

Lines are compared to the last digit. The instructions of another processor (kernels of BLAS and
libm, fused multiplications in the compiled NMPC) moved the robot of a flight by 1e-14 m, and left
every shown line as it is.
``RENEW=1 pytest test/tutorials`` writes the printed numbers into the pages.
"""

from dataclasses import dataclass, field
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import ready_program
from ros_flights import FLIGHTS

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / 'docs' / 'tutorials').glob('*.md'))
TIMEOUT = 1000       # s of one block
BLOCK = re.compile(r'(?P<before>[^\n]*)\n(?:\n<!-- test: (?P<options>[^\n]*) -->\n)?\n'
                   r'```(?P<language>\w*)\n(?P<text>.*?)^```$', re.DOTALL | re.MULTILINE)
DIGITS = re.compile(r'\d+(?:\.\d+)?')
NUMBER = re.compile(rf'(?<![\w.]){DIGITS.pattern}(?!\.?\w)')
NO_TEXT = re.compile(r'^```.*?^```$|^(?:## )?\d+\.|<!--.*?-->|\]\([^)]*\)',
                     re.DOTALL | re.MULTILINE)
RENEW = 'RENEW' in os.environ


@dataclass
class Block:
    """A fenced block: its language and text, its file name, instructions for the test."""

    language: str
    text: str
    file: str = ''
    options: list[str] = field(default_factory=list)

    def one(self, word):
        """The argument of an instruction; '' without it."""
        return next((option.removeprefix(word).strip() for option in self.options
                     if option.split(' ')[0] == word), '')

    @property
    def commands(self):
        """The text with the replacements of the test."""
        text = self.text
        for option in self.options:
            old, arrow, new = option.partition(' -> ')
            if arrow:
                assert old in text, f'{old!r} is not in the block'
                text = text.replace(old, new)
        return text


def blocks(page):
    """Executed, written and shown blocks of a page, in order."""
    found = []
    for match in BLOCK.finditer(page.read_text(encoding='utf-8')):
        options = [part.strip() for part in (match['options'] or '').split(', ') if part]
        file = re.search(r'as `([\w.]+)`:?$', match['before'])
        if match['language'] in ('sh', '') or file:
            found.append(Block(match['language'], match['text'], file[1] if file else '', options))
    return found


def variables():
    """Environment in which the modules of this checkout are found, with one thread."""
    return {**os.environ, 'COLUMNS': '120', 'PYTHONPATH': str(ROOT), 'OMP_NUM_THREADS': '1'}


@pytest.fixture(scope='module')
def client(tmp_path_factory):
    """Text of a `beetle_omni` that does not load its modules."""
    address = tmp_path_factory.mktemp('ready') / 'socket'
    process = subprocess.Popen([sys.executable, ready_program.__file__, str(address)],
                               env=variables(), start_new_session=True)
    try:
        end = time.monotonic() + 60
        while not address.exists():
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.05)
        yield ready_program.CLIENT.format(python=sys.executable, address=str(address))
    finally:
        os.killpg(process.pid, signal.SIGKILL)      # with calls after the timeout of a test
        process.wait()


@pytest.fixture
def shell(tmp_path, client):
    """Environment in which the commands of this checkout are found."""
    programs = tmp_path / 'programs'
    programs.mkdir()
    start = f'#!/bin/sh\nexec {sys.executable}'
    texts = {'beetle_omni': client, 'python': f'{start} "$@"\n',
             'sim_node': f'{start} -m beetle_omni_ros.start sim_node "$@"\n'}
    for name, text in texts.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    environment = {**variables(), 'PATH': f"{programs}:{os.environ['PATH']}"}
    environment.pop('ROS_DOMAIN_ID', None)
    return environment


def run(block, folder, environment):
    """Run one block like a reader who pastes it; return what it prints."""
    if block.one('waits'):
        end = time.monotonic() + 60
        while not (folder / block.one('waits')).exists() and time.monotonic() < end:
            time.sleep(0.1)
    done = subprocess.run(['bash', '-euo', 'pipefail', '-c', block.commands], cwd=folder,
                          env=environment, capture_output=True, text=True, timeout=TIMEOUT,
                          check=False)
    output = f'{block.commands}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}'
    assert done.returncode == int(block.one('fails') or 0), output
    assert block.one('prints') in done.stdout, output
    return done.stdout + done.stderr


def with_printed_numbers(shown, printed):
    """The shown lines, each with the numbers of the next printed line that has its words."""
    rest, lines = iter(printed.splitlines()), []
    for line in shown.splitlines():
        row = next((row for row in rest if words(row) == words(line)), None)
        assert row is not None, f'{line!r} is not printed, or earlier:\n{printed}'
        numbers = iter(DIGITS.findall(row))
        lines.append(DIGITS.sub(lambda _, left=numbers: next(left), line) + '\n')
    return ''.join(lines)


def words(line):
    """A line without the values of its numbers."""
    return DIGITS.sub('0', line).split()


def stop(process):
    """End a program like Ctrl-C."""
    process.send_signal(signal.SIGINT)
    process.wait(20)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_the_commands_of_a_tutorial_give_its_results(page, tmp_path, shell):
    found = blocks(page)
    if any('fly ' in block.text or block.one('background') for block in found):
        pytest.importorskip('rclpy')
    prepare, check = FLIGHTS.get(page.stem, (lambda folder: None,) * 2)
    folder, background, printed = tmp_path / 'reader', {}, ''
    folder.mkdir()
    prepare(folder)
    try:
        for block in found:
            if 'skip' in block.options:
                continue
            if block.one('ends'):
                stop(background.pop(block.one('ends')))
            if not block.language:
                assert all(one.commands == one.text for one in found[:found.index(block)])
                true = with_printed_numbers(block.text, printed)
                if RENEW:
                    page.write_text(page.read_text().replace(block.text, true))
                assert RENEW or block.text == true
            elif block.file:
                (folder / block.file).write_text(block.commands)
            elif block.one('background'):
                background[block.one('background')] = subprocess.Popen(
                    ['bash', '-c', f'exec {block.commands}'], cwd=folder, env=shell,
                    stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            else:
                printed = run(block, folder, shell)
    finally:
        for process in background.values():
            stop(process)
    check(folder)
    shutil.rmtree(folder)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_each_number_of_a_text_is_in_a_command_or_in_its_output(page):
    text = page.read_text()
    known = {number for block in re.findall(r'^```.*?^```$', text, re.DOTALL | re.MULTILINE)
             for number in NUMBER.findall(block)}
    for section in text.split('\n## '):
        if 'test: skip' not in section:     # it describes what no test can run
            said = NUMBER.findall(NO_TEXT.sub(' ', f'## {section}'))
            assert set(said) <= known, section
