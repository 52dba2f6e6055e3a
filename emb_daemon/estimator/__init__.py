"""The estimator of one corner: a pure step that knows no socket, clock, file or logger."""
