"""The database file itself: which file is open, how long to wait for it, and whether its tables are as expected."""
