"""The event log: its payloads and rows, what is derived from them, and undo."""
