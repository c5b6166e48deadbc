"""Limits that keep a server usable for those who have signed in, whatever others send."""
