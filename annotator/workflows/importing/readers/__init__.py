"""Reads 3D boxes in each format as a `ProposalSet`."""
