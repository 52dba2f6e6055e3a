"""Measures whether a machine meets the timing budgets of the daemon."""
