"""The robot in the browser: recorded runs beside each other, or a running graph."""
