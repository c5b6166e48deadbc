"""Objects over a recording: which boxes of its frames are one object, and what follows for their size and heading.

Pure functions on boxes and times; they know no file, no project and no detector.
"""
