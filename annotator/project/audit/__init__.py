"""The one door for changes, the audit that it writes, and undo."""
