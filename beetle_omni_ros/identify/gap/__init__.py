"""
`beetle_omni gap`, and flights of bags as the engine of ``identify.flights`` reads them.

- ``bags``, ``ingest``: read and check recordings.
- ``keys``, ``signals``, ``body``, ``servo``, ``residual``: parameters and signals of a flight.
- ``apply``, ``command``: robot file with the named effects; from recordings to all outputs.

Recurring names:

- robot: parameters of the robot file.
- p: parameters of the gap finder (params/gap.yaml).
- theta: deviations from the robot file, by key name.
"""
