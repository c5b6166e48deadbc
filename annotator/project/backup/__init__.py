"""Backups: making, restoring, automatic ones; verifying and repairing projects, and copying foreign ones."""
