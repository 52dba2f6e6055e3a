"""The demonstration: the simulated car and the real daemon on a bus inside one process."""
