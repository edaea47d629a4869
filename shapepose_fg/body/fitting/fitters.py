"""Which body fitter a pipeline runs with."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter, PlainFitterConfig
from shapepose_fg.body.fitting.learned import LearnedFitter, LearnedFitterConfig
from shapepose_fg.body.fitting.weights import FitterWeights, fingerprint
from shapepose_fg.body.model.body_model import BodyModel

Method = Literal["auto", "learned", "plain"]


@dataclass(frozen=True)
class BodyConfig:
    """How bodies are fitted."""

    method: str = "auto"
    """"learned": learned gradient descent; "plain": Levenberg-Marquardt; "auto": learned where the weights are for
    the body at hand, plain on any other body."""
    weights: str = ""
    """File of the learned fitter's weights (scripts/train_fitter.py); empty: those that come with the package."""
    learned: LearnedFitterConfig = field(default_factory=LearnedFitterConfig)
    """Settings of the learned fitter."""
    plain: PlainFitterConfig = field(default_factory=PlainFitterConfig)
    """Settings of the plain one."""

    @classmethod
    def paper(cls) -> "BodyConfig":
        """As written in Eq. 6: the network's steps, and nothing after them."""
        return cls(learned=LearnedFitterConfig(polish_steps=0, unfinished=1e6))

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {' '.join(get_args(Method))}, got {self.method!r}")


def make_fitter(
    config: BodyConfig | None = None, model: BodyModel | None = None
) -> "LearnedFitter | LevenbergMarquardtFitter":
    """The fitter that `config` asks for, on `model` or the shipped body.

    InputError where the learned one is asked for and its weights are missing, or for another body.
    """
    config = BodyConfig() if config is None else config
    model = BodyModel.default() if model is None else model
    if config.method == "plain":
        return LevenbergMarquardtFitter(model, config=config.plain)
    weights = FitterWeights.load(Path(config.weights)) if config.weights else FitterWeights.default()
    if config.method == "auto" and not config.weights and fingerprint(model) != weights.body:
        return LevenbergMarquardtFitter(model, config=config.plain)
    return LearnedFitter(model, config=config.learned, weights=weights)
