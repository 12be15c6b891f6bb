"""Gap finder: differences between model and measurement, and the effects that explain them."""
