"""Recordings of phones and tablets with a depth sensor."""
