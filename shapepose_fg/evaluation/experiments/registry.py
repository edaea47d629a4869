"""All experiments, in the order of the documentation."""

from collections.abc import Iterator

from shapepose_fg.evaluation.experiments import footage, scenes
from shapepose_fg.evaluation.experiments.experiment import Experiment
from shapepose_fg.evaluation.experiments.scenes import Scale

_EVERY = (footage.shelf, scenes.in_time, scenes.held_back, scenes.who_is_there, footage.views)


def experiments(scale: Scale) -> Iterator[Experiment]:
    """The experiments whose data are available."""
    return (found for make in _EVERY if len((found := make(scale)).cases) > 0)
