"""HTML pages of results: structure, tables, figures and interactive charts."""
