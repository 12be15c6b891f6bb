"""Fits with priors, coloured noise, intervals and cross-validation; independent of the robot."""
