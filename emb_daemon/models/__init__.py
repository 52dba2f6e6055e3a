"""The physical models, each a short file of compiled functions in SI units."""
