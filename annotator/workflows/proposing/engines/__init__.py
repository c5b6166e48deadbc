"""Engines that process the frames of a batch: in this process, in worker processes, or on a cluster.

`engine.py` is their interface, `inline.py`, `local.py` and `ray_engine.py` the three engines, and `choose.py` makes one
by name. All of them process frames with `runner.py`. Workers never access the project's database.
"""
