"""Virtual clamp force sensor for electro-mechanical brakes."""

__version__ = "0.1.0"
