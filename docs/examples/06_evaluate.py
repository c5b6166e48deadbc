"""Accuracy of 3D boxes from exact image boxes, with a perfect and an untrained view detector. Prints two tables."""

from tempfile import TemporaryDirectory

import annotator

with TemporaryDirectory() as folder:
    recording = annotator.generate_recording(f"{folder}/room", "hands", frames=3)
    frames = [recording.frame(i) for i in range(len(recording))]
    truth = {frame.key: annotator.read_truth(recording, i, frame) for i, frame in enumerate(frames)}
    # 2D boxes of whole objects, hidden parts included, like those of a detector trained on 3D labels
    exact = annotator.perfect_detector(recording, "box")

for name, views in (("exact views", exact), ("nearest cluster", annotator.NearestCluster("hand"))):
    results = annotator.propose(frames, image_detector=exact, view_detector=views, rotation="free")
    report = annotator.evaluate({result.key: result.proposals for result in results}, truth)
    print(f"\n{name}")
    for row in (report.columns, *report.rows):
        cells = (f"{cell:.2f}" if isinstance(cell, float) else str("" if cell is None else cell) for cell in row)
        print("".join(f"{cell:>14}" for cell in cells))
