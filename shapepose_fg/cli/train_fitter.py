"""The command `train-fitter`: weights of the learned fitter for a body model of one's own."""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

from shapepose_fg.cli.options import INPUT, RESULT, RUN, grouped, option
from shapepose_fg.cli.terminal import note, progress, show, table, warn
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.output_folder import prepare_output

_DRAWN = 30_000
"""Poses that are drawn where no recorded ones are given."""
_TARGETS = {"known to 10 mm": (0.01, 0.0), "to 20 mm, 30 % missing": (0.02, 0.3)}
"""What fitters are compared on: sigma, metres, and the share of joints without a target."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """How long, and how."""

    iterations: int = option(RUN, "Batches in all; 0 only measures how sure fits may be.", 500, min=0)
    batch: int = option(RUN, "People in each.", 256, min=16)
    seed: int = option(RUN, "Of everything that is drawn.", 0)
    threads: int = option(RUN, "Processor threads.", min(2, os.cpu_count() or 1), min=1)
    from_scratch: bool = option(RUN, "Begin with an untrained network; needs --motions.", False, "--from-scratch")


@grouped
def train_fitter(
    how: TrainingOptions,
    body: Path | None = option(INPUT, "Body model in SMPL's file format."),
    motions: Path | None = option(INPUT, "Recorded motions, a folder of AMASS's; without, poses are drawn."),
    output: Path | None = option(RESULT, "File for the weights (body.weights); by default the user's cache."),
) -> None:
    """Train the body fitter for a body model of yours; whatever has this --body then uses it.

    It begins with the weights that ship with the package, and is compared with the plain optimiser at the end.
    """
    if body is None and output is None:
        raise InputError("--body: missing; give the body model that shall be fitted")
    if how.from_scratch and motions is None:
        raise InputError("--from-scratch: poses that are drawn teach too little; give --motions")
    from shapepose_fg.body.fitting.fitters import SmplFitter
    from shapepose_fg.body.fitting.weights import adapted_file
    from shapepose_fg.body.model.body_model import BodyModel
    from shapepose_fg.body.threads import torch_threads
    from shapepose_fg.simulation.training.adaptation import compared, trained
    from shapepose_fg.simulation.training.motions import drawn_motions, load_motions
    from shapepose_fg.simulation.training.train import PeopleSource, TrainingConfig

    model = BodyModel.default() if body is None else BodyModel.load(body)
    file = adapted_file(model) if output is None else output
    prepare_output(file.parent, [file.name])
    if motions is None:
        learnt, kept = drawn_motions(_DRAWN, 2 * how.seed), drawn_motions(_DRAWN, 2 * how.seed + 1)
    else:
        learnt, kept = (load_motions(motions).of(split) for split in ("train", "validation"))
    for split, part in (("train", learnt), ("validation", kept)):
        if len(part) == 0:
            raise InputError(f"{motions}: no {split} subjects in it; add motions of more people")
    config = TrainingConfig(iterations=how.iterations, batch=how.batch, seed=how.seed)
    if not how.from_scratch:
        config = replace(config, learning_rate=config.learning_rate / 5)
    about, start = "poses drawn from the prior" if motions is None else motions.name, time.perf_counter()
    with torch_threads(how.threads):
        with progress("training", "batches") as shown:
            weights = trained(model, learnt, kept, config, about, from_scratch=how.from_scratch, progress=shown)
        fitters = {"trained": SmplFitter(model, weights=weights), "plain optimiser": SmplFitter(model)}
        unseen = PeopleSource(kept, model, weights.frame, replace(config, shake_rad=0.0, exchange=0.0))
        scores = {text: compared(fitters, unseen, *which) for text, which in _TARGETS.items()}
    rows = [
        (
            text,
            name,
            f"{score.joints_mm:.1f}",
            f"{score.missing_mm:.1f}" if which[1] > 0 else "-",
            f"{score.ms:.1f}",
        )
        for (text, which) in _TARGETS.items()
        for name, score in scores[text].items()
    ]
    minutes = (time.perf_counter() - start) / 60
    heads = ["joints", "fitter", "error, mm", "missing ones, mm", "ms a fit"]
    show(table(heads, rows, left=2, caption=f"256 bodies that taught nothing; {minutes:.1f} minutes in all"))
    worse = sum(each["trained"].joints_mm for each in scores.values()) > sum(
        each["plain optimiser"].joints_mm for each in scores.values()
    )
    if worse and output is None:
        warn(f"the plain optimiser is nearer on {body}: the weights are not kept; train longer (--iterations)")
        return
    weights.save(file)
    note(f"{file}: {file.stat().st_size / 1e6:.1f} MB" + ("" if output else f", for whatever has --body {body}"))
