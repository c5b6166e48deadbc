"""What waits for a review, in the order in which it is to be shown."""
