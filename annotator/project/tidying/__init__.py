"""Keeping projects tidy: recordings that are removed and come back, projects that are renamed or set aside."""
