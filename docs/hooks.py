"""Changes of the Markdown for the site."""

import re


def on_page_markdown(markdown: str, **_) -> str:
    """Remove backslashes before bars in code of tables, which the site would show."""
    return '\n'.join(re.sub('`[^`]+`', lambda code: code[0].replace(r'\|', '|'), line)
                     if line.lstrip().startswith('|') else line for line in markdown.split('\n'))
