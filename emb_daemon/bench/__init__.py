"""Whether a machine can hold the loop, measured on that machine."""
