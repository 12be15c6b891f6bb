"""
Blind flights for the gap workflow, and its score.

Everything that makes a flight here is written from the list of topics and units alone: own
numbers, own multibody model, own controller, own formulas of every effect. Nothing of the
package's model, simulator, controller or identification is imported (``test/gap_data`` holds
this), so that the workflow is not judged by its own equations.
"""
