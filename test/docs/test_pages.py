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
def test_a_cited_benchmark_exists_or_is_said_to_be_removed(page):
    for paragraph in read(page).split('\n\n'):
        for name in re.findall(r'benchmarks/[a-z]\w+\.py', paragraph):
            told = re.search(r'of commit \w{7}[^.]*removed\s+since', paragraph)
            assert (ROOT / name).is_file() or told, name


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
                       ('python', 'odom_quaternion')):
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
