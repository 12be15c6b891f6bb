"""Comparison of controllers in every published experiment: a sweep of flights and one page."""
