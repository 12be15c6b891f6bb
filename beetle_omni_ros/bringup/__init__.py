"""Bring-up of the real robot: look at everything, touch nothing, say what to do."""
