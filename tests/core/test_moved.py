"""Old names of modules."""

import sys
from importlib import import_module

import pytest

from shapepose_fg.core.moved import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_what_has_moved_is_found_by_its_old_name(old, monkeypatch):
    """The same module, not a second one, and a warning that names it."""
    monkeypatch.delitem(sys.modules, f"shapepose_fg.{old}", raising=False)
    with pytest.warns(DeprecationWarning, match=f"^shapepose_fg.{old} is shapepose_fg.{MOVED[old]} now$"):
        found = import_module(f"shapepose_fg.{old}")
    assert found is import_module(f"shapepose_fg.{MOVED[old]}")


def test_files_in_a_folder_that_has_moved(monkeypatch):
    monkeypatch.delitem(sys.modules, "shapepose_fg.report.scene", raising=False)
    with pytest.warns(DeprecationWarning, match="viz.report.scene now"):
        found = import_module("shapepose_fg.report.scene")
    assert found is import_module("shapepose_fg.viz.report.scene")


def test_the_pipeline_is_still_the_pipeline():
    import shapepose_fg
    from shapepose_fg.pipeline import PipelineConfig, reconstruct

    assert reconstruct is shapepose_fg.reconstruct and PipelineConfig is shapepose_fg.PipelineConfig
    with pytest.raises(ImportError, match="no_such_thing"):
        from shapepose_fg.pipeline import no_such_thing  # noqa: F401
