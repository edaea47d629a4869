"""Training that was stopped goes on where it was: networks and the optimiser's memory in one safetensors file."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from shapepose_fg.body.fitting.weights import read_tensors
from shapepose_fg.body.training.train import Trainer
from shapepose_fg.core.errors import InputError

_FORMAT = "shapepose-fg training 1"


def save_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write everything that the next iteration depends on; a file that is half written never takes its place."""
    tensors = {f"network.{name}": value for name, value in trainer.network.state_dict().items()}
    tensors |= {f"averaged.{name}": value for name, value in trainer.averaged.state_dict().items()}
    for row, memory in trainer.optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{row}.{name}": torch.as_tensor(value) for name, value in memory.items()}
    about = {"format": _FORMAT, "iteration": str(trainer.iteration), "config": _config(trainer)}
    part = path.with_suffix(".part")
    save_file({name: value.cpu().contiguous() for name, value in tensors.items()}, part, metadata=about)
    part.replace(path)


def load_checkpoint(trainer: Trainer, path: Path) -> None:
    """Continue from `path`; InputError where it is not a checkpoint of a run with the same settings."""
    about, tensors = read_tensors(path, "start the training afresh")
    if about.get("format") != _FORMAT or about.get("config") != _config(trainer):
        raise InputError(f"{path}: a checkpoint of other settings; give those, or start the training afresh")
    trainer.network.load_state_dict(_under("network.", tensors))
    trainer.averaged.load_state_dict(_under("averaged.", tensors))
    memory: dict[int, dict[str, Tensor]] = {}
    for name, value in _under("optimiser.", tensors).items():
        row, _, what = name.partition(".")
        memory.setdefault(int(row), {})[what] = value
    state = trainer.optimiser.state_dict()
    trainer.optimiser.load_state_dict(state | {"state": memory})
    trainer.iteration = int(about["iteration"])


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _config(trainer: Trainer) -> str:
    """All settings, as text."""
    return json.dumps(asdict(trainer.config), sort_keys=True)
