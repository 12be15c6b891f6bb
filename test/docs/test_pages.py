"""Pages: links exist, sentences and lines are short, and pages from code are up to date."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Pages with a style of their own: made by a command.
MADE = ('docs/comparison/', 'docs/reference/effects.md')


def module(name):
    """Load a program of docs/, which is no package."""
    spec = spec_from_file_location(name, ROOT / 'docs' / f'{name}.py')
    loaded = module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


pages = module('pages')
PAGES = [page.relative_to(ROOT).as_posix() for page in pages.written()]
REWRITTEN = [page for page in PAGES if not page.startswith(MADE)]


def read(page):
    """Text of a page."""
    return (ROOT / page).read_text(encoding='utf-8')


@pytest.mark.parametrize('page', [page for page in PAGES if not page.startswith('docs/')])
def test_every_relative_link_outside_the_site_has_a_file(page):
    for target in re.findall(r'\]\(([^():#]+)[^():]*\)', read(page)):
        assert (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize('page', REWRITTEN)
def test_no_sentence_is_longer_than_35_words(page):
    long = [f'{page}:{line}: {pages.words(text)} words: {text}'
            for line, text in pages.too_long(read(page))]
    assert not long, '\n'.join(long)


@pytest.mark.parametrize('page', REWRITTEN)
def test_sentences_have_20_words_on_average_at_most(page):
    lengths = [pages.words(sentence.text) for sentence in pages.sentences(read(page))]
    assert sum(lengths) <= 20 * max(1, len(lengths))


@pytest.mark.parametrize('page', REWRITTEN)
def test_no_line_of_text_is_wider_than_the_code(page):
    wide = [f'{page}:{line}: {len(text)} columns' for line, text in pages.too_wide(read(page))]
    assert not wide, '\n'.join(wide)


def test_the_readme_has_150_lines_at_most():
    assert len(read('README.md').splitlines()) <= 150


def test_the_page_of_effects_is_up_to_date():
    assert read('docs/reference/effects.md') == module('generate_reference').effects(), \
        'run python docs/generate_reference.py'


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """The built site; every page is in the navigation, and every link has its target."""
    pytest.importorskip('material')
    folder = tmp_path_factory.mktemp('site')
    done = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_the_pages_made_from_code(site):
    for page, text in (('parameters', 'rotors.time_constant'), ('topics', 'mocap/pose'),
                       ('command_line', '--controllers'), ('python', 'bo.simulate('),
                       ('python', 'odom_quaternion')):
        assert text in (site / 'reference' / f'{page}.html').read_text(encoding='utf-8'), page


def test_the_site_loads_nothing_from_the_network(site):
    outside = re.compile(
        r'<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=["\']?(?:https?:)?//[^>]*'
        r'|(?:@import\s*|url\()["\']?(?:https?:)?//[^)]*'
        # The theme's program loads what draws these elements.
        r'|class="?mermaid\b')
    files = [path for path in site.rglob('*') if path.suffix in ('.html', '.css')]
    assert len(files) > len(PAGES) - 4 and (site / 'search' / 'search_index.json').is_file()
    found = {path.name: loaded.group() for path in files
             if (loaded := outside.search(path.read_text(encoding='utf-8')))}
    assert not found


def test_the_start_page_links_every_tutorial_how_to_page_and_explanation():
    start = read('docs/index.md')
    missing = [page for page in PAGES if page.startswith(
        ('docs/tutorials/', 'docs/how-to/', 'docs/reference/', 'docs/explanation/'))
        and f"({page.removeprefix('docs/')})" not in start]
    assert not missing


def test_every_page_named_in_the_code_exists():
    for path in [*(ROOT / 'beetle_omni_ros').rglob('*.py'), *(ROOT / 'params').glob('*.yaml'),
                 *(ROOT / 'benchmarks').rglob('*.py'), ROOT / 'Makefile', ROOT / 'package.xml',
                 ROOT / '.ci' / 'setup', *(ROOT / 'launch').glob('*.py')]:
        for named in re.findall(r'(?<![\w/.])docs/[\w/-]+\.md', path.read_text(encoding='utf-8')):
            assert (ROOT / named).is_file(), f'{path.relative_to(ROOT)} names {named}'


@pytest.mark.parametrize(('text', 'words'), [
    ('One two. Three `four five` six.', [2, 3]),
    ('- An item\n  of two lines\n- another', [5, 1]),
    ('# Heading\n\n| a | table |\n\n```\ncode here\n```\nText 1.5 m long.', [4]),
    ('See [the page of it](page.md), e.g. here.', [7])])
def test_sentences_are_counted_as_a_reader_would(text, words):
    assert [pages.words(sentence.text) for sentence in pages.sentences(text)] == words


def test_bars_in_code_of_tables_are_plain_on_the_site():
    text = '| `--a x\\|y` | a \\| b `c` |\n\n    `x\\|y`\n'
    assert module('hooks').on_page_markdown(text, page=None) == \
        '| `--a x|y` | a \\| b `c` |\n\n    `x\\|y`\n'
