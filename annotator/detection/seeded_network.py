"""A network with weights generated from a seed, which any machine can create without training or download."""

from __future__ import annotations

from pathlib import Path

from annotator.detection.network_file import write_network
from annotator.detection.ultralytics_api import api

# Factor on the random weights of the last layers. Without it, they would predict distances of hundreds of pixels, and
# all scores would be 0 or 1.
LAST_LAYER_GAIN = 0.1
BRANCHES = ("cv2", "cv3", "one2one_cv2", "one2one_cv3")
PICTURES = (8, 3, 64, 64)


def write_seeded_network(
    path: Path, name: str = "yolo11n", *, classes: int = 3, end2end: bool = False, seed: int = 0
) -> None:
    """Writes a file of random weights that give scores around 0.5, so that the outputs of backends can be compared.

    The weights are the same on every machine up to rounding, since torch draws them from the seed on the CPU. The
    state of torch's random number generator is restored afterwards.

    Args:
        path: the file to write; its folder is created if missing.
        name: name of a detection model of ultralytics.
        classes: number of classes.
        end2end: whether the network predicts each object once; only some models support this.
        seed: seed of the weights.

    Raises:
        DetectionError: the packages cannot be loaded.
    """
    torch = api().torch
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = api().DetectionModel(f"{name}.yaml", nc=classes, verbose=False)
        model.end2end = end2end
        with torch.no_grad():
            for branch in BRANCHES:
                for layers in getattr(model.model[-1], branch, None) or ():
                    layers[-1].weight.mul_(LAST_LAYER_GAIN)
                    if "cv3" in branch:
                        layers[-1].bias.zero_()  # otherwise all scores would be nearly 0
            for module in model.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.momentum = 1.0
            # One pass in training mode sets the statistics of batch normalisation, as training would.
            model.train()(torch.rand(PICTURES))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_network(path, model)
