"""What the log tells about the work: who has labelled how much, at what cost, and how much is left."""
