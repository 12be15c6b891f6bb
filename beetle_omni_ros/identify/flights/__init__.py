"""
Gap finder: differences between model and flights, and the effects that explain them.

- ``keys``, ``body``, ``signals``, ``servo``; ``bag_flight``, ``table_flight``: residuals.
- ``spectrum``, ``discrepancy``, ``evidence``, ``engine``: evidence of sets of effects.
- ``quality``, ``balance``: shares, errors and further tests of a solution.
- ``verdict``, ``results``, ``page``, ``apply``, ``command``: verdict, JSON, page, robot file.
"""
