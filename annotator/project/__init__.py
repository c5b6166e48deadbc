"""What is kept: the project folder and its store."""
