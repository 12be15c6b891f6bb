"""
Three plain ways to look for a gap, to stand beside the workflow in the same table.

All share one linearised residual (:mod:`gap_data.baselines.residual`) and differ in how they
choose: every parameter at once, forward selection by BIC under white noise, and sparse regression
by thresholds. They answer in the interface's JSON.
"""
