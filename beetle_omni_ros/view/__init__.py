"""3D view in the browser: recorded runs over each other, or a running graph."""
