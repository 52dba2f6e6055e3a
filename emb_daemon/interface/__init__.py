"""The estimator for programs that are not in Python: a C header and an FMU, over the library that is compiled ahead."""
