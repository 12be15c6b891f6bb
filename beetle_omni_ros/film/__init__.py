"""Films of recorded flights: what flew, where it should have been, what a model expects."""
