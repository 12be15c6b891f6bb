"""Changes of the site: pages made from code, bars in code of tables, the repository's address."""

from pathlib import Path
import re
import subprocess
import sys

from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).parent))
from generate_reference import PAGES


def on_config(config):
    """
    Link to the repository that this is a checkout of, if it has an address.

    The theme would ask a forge for its stars; a link of the footer asks nothing.
    """
    found = subprocess.run(['git', 'config', 'remote.origin.url'], cwd=Path(__file__).parent,
                           capture_output=True, text=True, check=False).stdout.strip()
    address = re.sub(r'^git@([^:]+):', r'https://\1/', found).removesuffix('.git')
    if re.match(r'https?://[^@]*$', address):
        config.extra['social'] = [{'icon': 'material/source-repository', 'name': 'Repository',
                                   'link': address}]
    return config


def on_files(files, config):
    """Put pages made from code in the place of those that name where their content is."""
    for name, make in PAGES.items():
        files.remove(files.get_file_from_path(f'reference/{name}'))
        files.append(File.generated(config, f'reference/{name}', content=make()))
    return files


def on_page_markdown(markdown: str, **_) -> str:
    """Remove backslashes before bars in code of tables, which the site would show."""
    return '\n'.join(re.sub('`[^`]+`', lambda code: code[0].replace(r'\|', '|'), line)
                     if line.lstrip().startswith('|') else line for line in markdown.split('\n'))
