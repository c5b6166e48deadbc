"""What goes out and comes back: a parse/dump pair a format."""
