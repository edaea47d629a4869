"""The command `train-fitter`: trains the learned fitter for the user's body model."""

import time
from pathlib import Path

from shapepose_fg.cli.options import INPUT, REQUIRED, RESULT, RUN, grouped, option
from shapepose_fg.cli.terminal import note, progress, show, table, warn
from shapepose_fg.core.errors import InputError, optional
from shapepose_fg.core.storage.output_folder import prepare_output


@grouped
def train_fitter(
    body: Path = option(INPUT, "Body model in SMPL's file format.", REQUIRED),
    motions: Path | None = option(
        INPUT,
        "Folder of recorded motions in AMASS's format; without it, poses are drawn at random.",
    ),
    output: Path | None = option(
        RESULT, "File for the weights (setting body.weights); by default in the user's cache."
    ),
    iterations: int = option(
        RUN, "Number of batches; 0 only calibrates the uncertainty of the fits.", 500, min=0
    ),
    batch: int = option(RUN, "Number of people in a batch.", 256, min=16),
    seed: int = option(RUN, "Random seed.", 0),
) -> None:
    """Train the body fitter for your own body model; all commands with this --body then use it.

    Training starts from the built-in weights. At the end, the result is compared with the plain
    optimiser.
    """
    torch = optional("torch", "train")
    from shapepose_fg.body.fitting.weights import FitterWeights, adapted_file, fingerprint
    from shapepose_fg.body.model.body_model import BodyModel
    from shapepose_fg.simulation.training.adaptation import PLAIN, TRAINED, adapted
    from shapepose_fg.simulation.training.motions import drawn_motions, load_motions
    from shapepose_fg.simulation.training.train import TrainingConfig

    model = BodyModel.load(body)
    if output is None and fingerprint(model) == FitterWeights.default().body:
        raise InputError(
            f"{body}: this body model has weights in the package; give --output to train others"
        )
    file = adapted_file(model) if output is None else output
    prepare_output(file.parent, [file.name])
    if motions is None:
        # Number of random poses if no recorded ones are given.
        learnt, unseen = (drawn_motions(30_000, 2 * seed + part) for part in (0, 1))
    else:
        learnt, unseen = (load_motions(motions).of(split) for split in ("train", "validation"))
    for split, part in (("train", learnt), ("validation", unseen)):
        if len(part) == 0:
            raise InputError(
                f"{motions}: there are no {split} subjects; add motions of more people"
            )
    config = TrainingConfig(iterations=iterations, batch=batch, seed=seed)
    card = {
        "data": "poses drawn from the prior"
        if motions is None
        else f"{len(learnt)} frames of {motions.name}"
    }
    start = time.perf_counter()
    torch.set_num_threads(1)
    with progress("training", "batches") as shown:
        weights, scores = adapted(model, learnt, unseen, config, card, shown)
    rows = [(name, f"{score.joints_mm:.1f}", f"{score.ms:.1f}") for name, score in scores.items()]
    minutes = (time.perf_counter() - start) / 60
    caption = f"on unseen poses with some joints missing; training took {minutes:.0f} minutes"
    show(table(["fitter", "error, mm", "ms per fit"], rows, caption=caption))
    # Ratio of the error to that of the plain optimiser above which weights are rejected
    # (the learned fitter takes half the time).
    if output is None and scores[TRAINED].joints_mm > 1.1 * scores[PLAIN].joints_mm:
        warn(
            f"the plain optimiser is more accurate on {body}, so these weights are not stored; "
            "give more --iterations"
        )
        return
    weights.save(file)
    note(
        f"{file}: {file.stat().st_size / 1e6:.1f} MB"
        + ("" if output else f", used with --body {body}")
    )
