"""How results are shown: tables, figures, HTML pages, the viewer."""
