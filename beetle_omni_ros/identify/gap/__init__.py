"""Where model and measurement disagree, and which named effect explains it."""
