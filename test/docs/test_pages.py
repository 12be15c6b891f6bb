"""Pages: links exist, and pages from code are up to date."""

from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [page.relative_to(ROOT).as_posix() for page in (
    *ROOT.glob('*.md'), *ROOT.glob('policies/*.md'), *ROOT.glob('docs/**/*.md'))]


def read(page):
    """Text of a page."""
    return (ROOT / page).read_text(encoding='utf-8')


@pytest.mark.parametrize('page', PAGES)
def test_every_relative_link_has_a_file_in_a_checkout(page):
    for target in re.findall(r'\]\(([^():#]+)[^():]*\)', read(page)):
        assert (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize('page', PAGES)
def test_every_cited_file_of_the_repository_exists(page):
    """From the root, package or page; `NAME` stands for any, `runs` are the reader's."""
    text = read(page)
    made = re.findall(r'Save\s+\w+\s+as\s+`([^`]+)`', text)
    for name in re.findall(
            r'(?<![\w/.$~<>:*-])(?:[\w.-]+/)+[\w-]+\.(?:py|md|yaml|csv|onnx|html)\b', text):
        places = ROOT, ROOT / 'beetle_omni_ros', (ROOT / page).parent
        assert name in made or re.search(r'NAME|^runs', name) or any(
            (place / name).is_file() for place in places), name


@pytest.mark.parametrize('page', PAGES)
def test_a_sentence_has_at_most_35_words(page):
    text = re.sub(r'```.*?```|<!--.*?-->', '', read(page), flags=re.S)
    text = re.sub(r'\]\([^)]*\)', ']', re.sub(r'`[^`]*`', 'X', text))
    # a cell, a point of a list and a heading end a sentence
    for sentence in re.split(r'\n\s*\n|\n\s*(?:[-*]|\d+\.) |\n#|(?<!\\)\||'
                             r'(?<=[.!?])\s+(?=[A-Z`*\[("\d])', text):
        words = [word for word in sentence.split() if re.search(r'\w', word)]
        assert len(words) <= 35 or set(words) == {'X,', 'X'}, ' '.join(words)


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


def test_the_site_has_the_pages_made_from_code(site, monkeypatch):
    for page, text in (('parameters', 'rotors.time_constant'), ('topics', 'mocap/pose'),
                       ('command_line', '--controllers'), ('python', 'bo.simulate('),
                       ('python', 'angular_velocity')):
        assert text in (site / 'reference' / f'{page}.html').read_text(encoding='utf-8'), page
    monkeypatch.syspath_prepend(ROOT / 'docs')
    import generate_reference
    import hooks
    for page in generate_reference.IN_FULL:
        assert read(f'docs/reference/{page}') == generate_reference.PAGES[page](), \
            'run python docs/generate_reference.py'
    table = '| `--a x\\|y` | a \\| b `c` |\n\n    `x\\|y`\n'
    assert hooks.on_page_markdown(table) == '| `--a x|y` | a \\| b `c` |\n\n    `x\\|y`\n'


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


def test_every_page_named_in_the_code_exists(site):
    for path in [*(ROOT / 'beetle_omni_ros').rglob('*.py'), *(ROOT / 'params').glob('*.yaml'),
                 *(ROOT / 'benchmarks').rglob('*.py'), ROOT / 'Makefile', ROOT / 'package.xml',
                 ROOT / '.ci' / 'setup', *(ROOT / 'launch').glob('*.py')]:
        for named in re.findall(r'(?<![\w/.])docs/[\w/-]+\.md', path.read_text(encoding='utf-8')):
            made = (site / named.removeprefix('docs/')).with_suffix('.html')
            assert (ROOT / named).is_file() or made.is_file(), \
                f'{path.relative_to(ROOT)} names {named}'
