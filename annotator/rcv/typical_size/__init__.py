"""Objects of a class with a typical size: where a box of about this size may be, and which is best."""
