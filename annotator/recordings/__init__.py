"""Reads recordings: one reader per format, behind `open_recording`."""

from annotator.recordings.open import ADVICE, detect_format, kinds, nearest_formats, open_recording
from annotator.recordings.recording import ReaderOptions, Recording, parse_options, stored_options
