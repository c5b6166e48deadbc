"""Long work in processes of its own: train, propose, export. One at a time, the others wait."""
