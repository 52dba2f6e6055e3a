"""A simulated electro-mechanical brake and the car around it, used by demo, simulate and the tests.

The plant shares no code with the estimator wherever the two could agree by construction: it integrates differential equations
in sub-steps, has states that the estimator does not model, and computes heat on another mesh with another scheme.
"""
