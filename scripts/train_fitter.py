"""Train the learned fitter's update network: python scripts/train_fitter.py cmu_smpl24.npz.

Learns from the training subjects of recorded motions (CMU's .npz or a folder of AMASS files), watches the
validation subjects, never sees the test subjects. Writes a log (one JSON line for each validation), and at the end
the weights with their card. About an hour on one core.
"""

import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.progress import Progress, TimeRemainingColumn

from shapepose_fg.body.fitting.descent import LearnedDescent, gradient_scale
from shapepose_fg.body.fitting.network import UpdateNetwork, num_weights
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import versions
from shapepose_fg.simulation.training.motions import (
    ACKNOWLEDGEMENT,
    TEST_SUBJECTS,
    VALIDATION_SUBJECTS,
    Motions,
    load_motions,
)
from shapepose_fg.simulation.training.train import (
    PeopleSource,
    Trainer,
    TrainingConfig,
    body_points,
    calibrated,
    prepared,
)

VALIDATION_PEOPLE = 2048


def main(
    motions: Annotated[Path, typer.Argument(help="cmu_smpl24.npz, or a folder of AMASS .npz files.")],
    output: Annotated[Path, typer.Option(help="Where the weights go.")] = Path("fitter.safetensors"),
    body: Annotated[Path | None, typer.Option(help="SMPL file to train for; the open body without.")] = None,
    iterations: Annotated[int, typer.Option(min=1, help="Batches in all.")] = TrainingConfig.iterations,
    batch: Annotated[int, typer.Option(min=16, help="People in each.")] = TrainingConfig.batch,
    seed: Annotated[int, typer.Option(help="Of everything that is drawn.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    validate_every: Annotated[int, typer.Option(min=1, help="Iterations between validations.")] = 500,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Only measure the covariances of the weights in the output anew.")
    ] = False,
) -> None:
    """Train, validate, write."""
    torch.set_num_threads(threads)
    _refuse_unwritable(output)
    config = replace(TrainingConfig(), iterations=iterations, batch=batch, seed=seed)
    model = BodyModel.default() if body is None else BodyModel.load(body)
    recorded = load_motions(motions)
    for split in ("train", "validation"):
        if len(recorded.of(split)) == 0:
            raise InputError(
                f"{motions}: no {split} subjects in it; add motions of more people (training/motions.py)"
            )
    if calibrate:
        weights = FitterWeights.load(output)
        _calibrated(weights, recorded, model, config).save(output)
        return
    train = recorded.of("train")
    frame = PersonFrame.of(model, train.poses, train.weight)
    trainer = _trainer(recorded, model, frame, config)
    log = output.with_suffix(".log")
    validation = _people_to_validate(recorded, model, frame, config)
    columns = (*Progress.get_default_columns()[:-1], TimeRemainingColumn())
    with Progress(*columns) as progress:
        bar = progress.add_task("training", total=iterations)
        for errors in trainer.run(iterations):
            progress.update(bar, advance=1, description=f"joints {errors[-1]:.0f} mm")
            if trainer.iteration % validate_every == 0 or trainer.iteration == iterations:
                line = {"iteration": trainer.iteration, "time": round(time.time())}
                line |= {"validation_mm": [round(error, 2) for error in validation(trainer.averaged)]}
                with log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
    card = _card(trainer, recorded, motions, validation(trainer.averaged))
    network = trainer.averaged.requires_grad_(False).eval().cpu()
    weights = FitterWeights(network, frame, fingerprint(model), card=card)
    _calibrated(weights, recorded, model, config).save(output)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB, {num_weights(trainer.averaged)} weights")


def _refuse_unwritable(output: Path) -> None:
    """InputError where the weights could not be written in the end."""
    for file in (output, output.with_suffix(".log")):
        if file.is_dir():
            raise InputError(f"{file}: this is a folder; give another --output")
        if file.exists() and not os.access(file, os.W_OK):
            raise InputError(f"{file}: it may not be written; give another --output")
    try:
        with tempfile.TemporaryFile(dir=output.parent):
            pass
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror}); give another --output") from None


def _calibrated(
    weights: FitterWeights, recorded: Motions, model: BodyModel, config: TrainingConfig
) -> FitterWeights:
    """The weights with covariances that hold on the validation subjects."""
    still = replace(config, shake_rad=0.0, exchange=0.0)
    return calibrated(weights, PeopleSource(recorded.of("validation"), model, weights.frame, still), model)


def _trainer(recorded: Motions, model: BodyModel, frame: PersonFrame, config: TrainingConfig) -> Trainer:
    """A run that has not begun; the network lives on a GPU where there is one, the bodies on the CPU."""
    torch.manual_seed(config.seed)
    network = UpdateNetwork(config.network)
    network.gradient_scale.copy_(gradient_scale(model.points, tuple(range(25))))
    network.to("cuda" if torch.cuda.is_available() else "cpu")
    return Trainer(PeopleSource(recorded.of("train"), model, frame, config), frame, network, config)


def _people_to_validate(recorded: Motions, model: BodyModel, frame: PersonFrame, config: TrainingConfig):
    """A function: the mean joint error in mm after each step of a network, on the same people each time."""
    still = replace(config, shake_rad=0.0, exchange=0.0)
    source = PeopleSource(recorded.of("validation"), model, frame, still)
    generator = torch.Generator().manual_seed(1)
    people = source.draw(VALIDATION_PEOPLE, generator)
    targets, start, _, true_points = prepared(people, frame, still, generator)
    everything = tuple(range(len(BODY_POINTS)))

    @torch.no_grad()
    def errors(network: UpdateNetwork) -> list[float]:
        network.eval()
        descent = LearnedDescent(model.points, everything, network, config.kernel_scale)
        distances = [body_points(model, state) - true_points for state in descent.unroll(start, targets)]
        return [1000 * float(torch.linalg.vector_norm(distance, dim=-1).mean()) for distance in distances]

    return errors


def _card(trainer: Trainer, recorded: Motions, motions: Path, errors: list[float]) -> dict[str, str]:
    """What a reader of the weights wants to know."""
    train, config = recorded.of("train"), trainer.config
    return {
        "data": f"{motions.name}: {len(train)} frames of {len(set(train.subject.tolist()))} subjects for training",
        "not seen": f"subjects {' '.join(VALIDATION_SUBJECTS)} (validation), {' '.join(TEST_SUBJECTS)} (test)",
        "command": f"python scripts/train_fitter.py {motions.name} --iterations {config.iterations}"
        f" --batch {config.batch} --seed {config.seed}",
        "validation": "mean joint error after each step, mm: " + ", ".join(f"{error:.1f}" for error in errors),
        "acknowledgement": ACKNOWLEDGEMENT,
        "made with": json.dumps(versions()),
    }


if __name__ == "__main__":
    try:
        typer.run(main)
    except (InputError, OSError) as problem:
        print(f"error: {' '.join(str(problem).split())}", file=sys.stderr)
        sys.exit(2)
