"""Topics, their messages and the values in them, for nodes and bags."""
