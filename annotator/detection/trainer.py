"""Ultralytics' detection trainer, adapted to small training sets and to a CPU.

It differs from the original in these points: an optimiser step after every batch (the original accumulates 64 images,
so a set of 100 gets few steps); Muon in float32; all cores instead of all but one; channels-last memory;
validation every few epochs only; atomic checkpoints; no search for fonts and no network access.

This module imports ultralytics; import it only to train.
"""

from __future__ import annotations

import time
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import torch

from annotator.detection.trained import BEST, LAST, read_checkpoint, write_checkpoint
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights

if TYPE_CHECKING:
    from annotator.detection.training import Watch

# Muon with SGD, the most accurate optimiser on small training sets, fast enough for a CPU.
#
# Muon (K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024) replaces each weight
# matrix's momentum by approximately the nearest semi-orthogonal matrix, found by Newton-Schulz iteration. Ultralytics
# trains YOLO26 with a mix of Muon and SGD. Its version computes in bfloat16 and pads matrices to batches, which suits
# GPUs; on a CPU it takes nearly as long as the rest of a training step. This version computes in float32 and batches
# equal shapes only.
#
# This module imports torch; import it only to train.


# Coefficients and number of the Newton-Schulz iterations, from the Muon paper.
NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
# The learning rate of the Muon part, as a share of that of the SGD part.
MUON_SHARE = 0.2


def orthogonalised(matrices: torch.Tensor) -> torch.Tensor:
    """The (n, rows, columns) matrices with all singular values moved close to 1 (0.7 to 1.2)."""
    a, b, c = NEWTON_SCHULZ
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-7)
    tall = x.shape[1] > x.shape[2]
    if tall:
        x = x.transpose(1, 2)
    for _ in range(ITERATIONS):
        gram = x @ x.transpose(1, 2)
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.transpose(1, 2) if tall else x


class MuonSgd(torch.optim.Optimizer):
    """SGD with Nesterov momentum for all parameters, plus a Muon update for groups with `use_muon`.

    Groups have `lr`, `momentum`, `weight_decay` (of the SGD part) and `use_muon`. Parameters of a Muon group have at
    least two dimensions; all but the first are flattened.
    """

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        super().__init__(groups, {"lr": 0.01, "momentum": 0.9, "weight_decay": 0.0, "use_muon": False})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """One update from the gradients; `closure` is not supported."""
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            lr, momentum = group["lr"], group["momentum"]
            if group["use_muon"]:
                self._muon_part(parameters, lr * MUON_SHARE, momentum)
            buffers = self._buffers(parameters, "momentum_sgd")
            gradients = [p.grad for p in parameters]
            if group["weight_decay"]:
                gradients = torch._foreach_add(gradients, parameters, alpha=group["weight_decay"])
            torch._foreach_mul_(buffers, momentum)
            torch._foreach_add_(buffers, gradients)
            torch._foreach_add_(parameters, torch._foreach_add(gradients, buffers, alpha=momentum), alpha=-lr)

    def _muon_part(self, parameters: list[torch.Tensor], lr: float, momentum: float) -> None:
        buffers = self._buffers(parameters, "momentum_muon")
        gradients = [p.grad for p in parameters]
        torch._foreach_lerp_(buffers, gradients, 1 - momentum)
        ahead = torch._foreach_lerp(gradients, buffers, momentum)
        by_shape: dict[torch.Size, list[int]] = defaultdict(list)
        for index, parameter in enumerate(parameters):
            by_shape[parameter.shape].append(index)
        for shape, indices in by_shape.items():
            rows, columns = shape[0], shape[1:].numel()
            update = orthogonalised(torch.stack([ahead[i].reshape(rows, columns) for i in indices]))
            step = lr * max(1.0, rows / columns) ** 0.5
            for i, change in zip(indices, update, strict=True):
                parameters[i].add_(change.reshape(shape), alpha=-step)

    def _buffers(self, parameters: list[torch.Tensor], name: str) -> list[torch.Tensor]:
        for parameter in parameters:
            if name not in self.state[parameter]:
                self.state[parameter][name] = torch.zeros_like(parameter)
        return [self.state[parameter][name] for parameter in parameters]


_API = api()
_Trainer: Any = _API.DetectionTrainer
# Learning rate factor of the classification branch, whose biases are initialised for rare objects; as in Ultralytics.
HEAD_LR_FACTOR = 3.0
# Momentum of the batch normalisation statistics. Ultralytics' 0.03 suits runs of many thousand steps; after a hundred
# steps, the statistics would still be those of random weights.
NORM_MOMENTUM = 0.1
# Minimum time between checkpoints. Writing one takes a second, longer than an epoch over a few small images.
SAVE_EVERY_S = 20.0


class ViewTrainer(_Trainer):
    """The trainer; `make_trainer` sets `watch` before ultralytics' set-up runs."""

    watch: Watch
    model: Any
    saved_at_s = 0.0
    metrics: Any
    fitness: float | None

    def get_dataset(self) -> dict[str, Any]:
        folder, manifest = self.watch.dataset.resolve(), self.watch.manifest
        return {
            "path": folder,
            "yaml_file": str(folder / "data.yaml"),
            "train": str(folder / "images" / "train"),
            "val": str(folder / "images" / manifest.measured_on),
            "names": dict(enumerate(manifest.classes)),
            "nc": len(manifest.classes),
            "channels": 3,
        }

    def get_model(self, cfg: Any = None, weights: Any = None, verbose: bool = True) -> Any:
        # The initial weights depend only on the seed.
        _API.torch.manual_seed(self.args.seed)
        model = super().get_model(cfg, weights, verbose=False)
        for module in model.modules():
            if isinstance(module, _API.torch.nn.BatchNorm2d):
                module.momentum = NORM_MOMENTUM
        return model

    def _setup_train(self) -> None:
        # The base class has just limited torch to one thread fewer than cores.
        _API.torch.set_num_threads(_API.threads)
        super()._setup_train()
        if self.watch.device.type == "cpu":
            self.model = self.model.to(memory_format=_API.torch.channels_last)

    def preprocess_batch(self, batch: dict[str, Any]) -> dict[str, Any]:
        batch = super().preprocess_batch(batch)
        if self.watch.device.type == "cpu":
            batch["img"] = batch["img"].contiguous(memory_format=_API.torch.channels_last)
        return batch

    def build_optimizer(
        self,
        model: Any,
        name: str = "auto",
        lr: float = 0.01,
        momentum: float = 0.9,
        decay: float = 0.0,
        iterations: float | int = 0,
    ) -> Any:
        if name == "MuonSgd":
            return MuonSgd(parameter_groups(model, lr, momentum, decay))
        return super().build_optimizer(model, name, lr, momentum, decay, iterations)

    def validate(self) -> Any:
        if (self.epoch + 1) % self.watch.measure_every == 0 or self.epoch + 1 >= self.epochs or self.stop:
            return self.validate_now()
        return dict.fromkeys(self.metrics, float("nan")), None

    def validate_now(self) -> Any:
        """Validates this epoch; returns its figures and its fitness."""
        return super().validate()

    def check_resume(self, overrides: dict[str, Any]) -> None:
        """Decides whether the run is resumed; its settings are always those given."""
        self.resume = self.watch.checkpoint is not None

    def setup_model(self) -> Any:
        """Builds the network; returns the checkpoint to resume from, or None."""
        checkpoint = weights = None
        if self.watch.checkpoint is not None:
            checkpoint = read_checkpoint(self.watch.checkpoint)
            weights = checkpoint["ema"]
        elif self.watch.weights is not None:
            weights = load_weights(self.watch.weights, "cpu")
        self.model = self.get_model(cfg=self.model if weights is None else weights.yaml, weights=weights)
        return checkpoint

    def save_model(self) -> bool:
        """Writes the checkpoints, which are no pickles as those of the base class; not after every short epoch."""
        measured, last = self.fitness is not None, self.epoch + 1 >= self.epochs
        if measured or last or time.monotonic() - self.saved_at_s > SAVE_EVERY_S:
            self.wdir.mkdir(parents=True, exist_ok=True)
            record = self.watch.record
            # a run of fixed duration is never resumed, since its settings depend on the clock
            write_checkpoint(self.wdir / LAST, self, record, with_optimiser=self.watch.limit_s is None)
            if self.best_fitness == self.fitness:
                write_checkpoint(self.wdir / BEST, self, record, with_optimiser=False)
            self.saved_at_s = time.monotonic()
        self.watch.on_epoch(self)
        return True

    def _handle_nan_recovery(self, epoch: int) -> bool:
        """Ends a run whose loss is no longer finite; the base class would read a checkpoint of its own format."""
        if self.loss is not None and not self.loss.isfinite() and epoch > self.start_epoch:
            raise RuntimeError("the loss is no longer a finite number; use a smaller learning rate")
        return False

    def final_eval(self) -> None:
        """Validates the last epoch, if that has not been done: a run of fixed duration may end after any epoch."""
        if self.fitness is None:
            self.metrics, self.fitness = self.validate_now()
            self.save_model()


def make_trainer(overrides: dict[str, Any], watch: Watch) -> ViewTrainer:
    """A trainer that is ready for `train()`; `overrides` are ultralytics' settings."""
    ready = type("ReadyTrainer", (ViewTrainer,), {"watch": watch})
    trainer = ready(overrides=overrides)
    trainer.add_callback("on_train_batch_end", watch.on_batch)
    return trainer


def parameter_groups(model: Any, lr: float, momentum: float, decay: float) -> list[dict[str, Any]]:
    """Parameter groups: weights (Muon, with decay), biases and normalisation (neither), separate for the classification
    branches.
    """
    head = model.model[-1]
    branches = (getattr(head, "cv3", None), getattr(head, "one2one_cv3", None))
    boosted = {id(p) for branch in branches if branch is not None for p in branch.parameters()}
    groups: dict[tuple[str, bool], list[Any]] = {}
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        kind = "muon" if parameter.ndim >= 2 else "bias" if name.endswith("bias") else "bn"
        groups.setdefault((kind, id(parameter) in boosted), []).append(parameter)
    return [
        {
            "params": parameters,
            "param_group": kind,
            "use_muon": kind == "muon",
            "lr": lr * (HEAD_LR_FACTOR if boost else 1.0),
            "momentum": momentum,
            "weight_decay": decay if kind == "muon" else 0.0,
        }
        for (kind, boost), parameters in groups.items()
    ]
