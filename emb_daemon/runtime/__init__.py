"""The running daemon: buses, real-time set-up, service manager, loop."""
