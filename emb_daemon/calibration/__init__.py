"""Calibration and configuration files: typed, strict, and turned into the estimator's parameter records."""
