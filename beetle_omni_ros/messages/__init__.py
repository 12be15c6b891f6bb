"""Topics, their messages and the values in them: said once, for nodes and bags alike."""
