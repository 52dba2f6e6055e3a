"""Live view of a running daemon, from its broadcasts alone."""
