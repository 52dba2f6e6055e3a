"""A simulated electro-mechanical brake and the car around it: what demo, simulate and the tests drive the daemon with.

The plant shares no code with the estimator where the two could agree by construction: it integrates differential equations
in sub-steps, has more states than the estimator knows of, and its heat runs on another mesh by another scheme.
"""
