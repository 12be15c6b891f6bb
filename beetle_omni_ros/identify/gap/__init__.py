"""
Gap finder: differences between model and measurement, and the effects that explain them.

Steps of an analysis of flights (a response log of the servos has its own: ``joint_gap``):

- ``bags``, ``ingest``: read and check recordings.
- ``keys``, ``signals``, ``body``, ``servo``, ``residual``: parameters and residuals of a flight.
- ``noise``, ``fit``: coloured noise, and Gauss-Newton fits of several flights.
- ``candidates``, ``proposals``, ``gates``, ``bands``, ``search``: selection of effects.
- ``certainty``, ``unknown``, ``patterns``, ``rollouts``: intervals, unexplained rest, free runs.
- ``verdict``, ``results``, ``page``, ``apply``: verdict, JSON and tables, page, robot file.

Recurring names:

- robot: parameters of the robot file.
- p: parameters of the gap finder (params/gap.yaml).
- theta: deviations from the robot file, by key name.
- problem, state: flights, priors and noise; a point of their fit.
- names, involved: keys that a fit changes. free: those whose priors are ignored.
- r, slopes: whitened residual (n,) and its derivatives (n, K).
- gain: decrease of the objective, in chi2.
"""
