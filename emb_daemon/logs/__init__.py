"""Log files: frames and columns in, tables and frames out."""
