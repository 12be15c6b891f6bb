"""Films of recorded flights with their targets or with the prediction of a model."""
