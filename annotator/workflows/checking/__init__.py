"""Checks of datasets and of project labels, and the rules that both share."""
