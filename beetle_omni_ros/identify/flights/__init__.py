"""
Gap finder: differences between model and flights, and the effects that explain them.

- ``table``, ``motion``, ``residual``; ``bag``: residuals of flights as tables, and as bags.
- ``priors``, ``spectrum``, ``discrepancy``, ``evidence``, ``engine``: evidence of effects.
- ``table_verdict``, ``bag_verdict``, ``results``, ``text``, ``page``: verdict, JSON, sentence,
  tables, page.
"""
