"""The command line. Each command checks its output paths before any heavy import and any work."""
