"""Fits with priors, coloured noise, intervals and selection on held-out blocks; knows no robot."""
