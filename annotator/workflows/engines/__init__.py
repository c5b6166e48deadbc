"""Where the frames of a batch are worked on: in this process, in worker processes, or on a cluster.

`engine.py` says what all have in common, `inline.py`, `local.py` and `ray_engine.py` are the three, `choose.py` makes
the one that was asked for. What is done with a frame is the same everywhere (`runner.py`); workers never see the
project's database.
"""
