"""SUN RGB-D: VoteNet's folder layout and the data set's own label table."""
