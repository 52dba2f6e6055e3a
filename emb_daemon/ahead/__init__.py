"""Kernels compiled ahead: one shared library for a computer that has no compiler."""
