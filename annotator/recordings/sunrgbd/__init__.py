"""SUN RGB-D recordings: VoteNet's extraction, and raw scenes."""
