"""What a running daemon says, seen from its broadcasts alone."""
