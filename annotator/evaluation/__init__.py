"""How good boxes are, against truth."""
