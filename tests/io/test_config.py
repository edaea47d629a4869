"""Settings: TOML tables onto nested dataclasses, and the printed defaults back."""

from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from pathlib import Path

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.validation import describe
from shapepose_fg.io.config import read_config, toml_text
from shapepose_fg.pipeline.config import PeopleConfig
from shapepose_fg.pipeline.pipeline import PipelineConfig


class Kernel(StrEnum):
    HUBER = "huber"
    CAUCHY = "cauchy"


@dataclass(frozen=True)
class Gate:
    """A gate."""

    gate_px: float = 20.0
    """Largest residual, pixels."""
    min_views: int = 2

    def __post_init__(self) -> None:
        if self.gate_px <= 0:
            raise ValueError(f"gate_px must be positive, got {self.gate_px:g}")


@dataclass(frozen=True)
class Config:
    """Settings with a table in them."""

    kernel: Kernel = Kernel.HUBER
    """The robust kernel."""
    weights: tuple[float, ...] = (1.0, 0.5)
    verbose: bool = False
    seed: int | None = None
    gate: Gate = field(default_factory=Gate)
    """The gate of Eq. 2."""


def read(folder: Path, text: str) -> Config:
    path = folder / "settings.toml"
    path.write_text(text)
    return read_config(path, Config)


def test_what_is_not_in_the_file_keeps_its_default(tmp_path):
    assert read(tmp_path, "") == Config()
    text = 'kernel = "cauchy"\nweights = [1, 2.5]\nseed = 3\n[gate]\ngate_px = 15\n'
    expected = Config(kernel=Kernel.CAUCHY, weights=(1.0, 2.5), seed=3, gate=Gate(gate_px=15.0))
    assert read(tmp_path, text) == expected
    assert isinstance(read(tmp_path, text).gate.gate_px, float)


def test_printed_settings_read_back(tmp_path):
    config = Config(kernel=Kernel.CAUCHY, weights=(), seed=1, verbose=True, gate=Gate(1e-7, 3))
    assert read(tmp_path, toml_text(config)) == config
    assert read(tmp_path, toml_text(Config())) == Config()


def test_printed_settings_carry_their_docstrings():
    text = toml_text(Config())
    assert '# The robust kernel.\nkernel = "huber"\n' in text
    assert (
        "# The gate of Eq. 2.\n[gate]\n# Largest residual, pixels.\ngate_px = 20.0\nmin_views = 2\n"
        in text
    )
    assert "# seed is not set\n" in text


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "[gate]\ngate_pixels = 3",
            "gate.gate_pixels is not a known key; did you mean gate.gate_px?",
        ),
        ("kernels = 'huber'", "kernels is not a known key; did you mean kernel?"),
        ("[gates]\ngate_px = 3", "gates is not a known key; did you mean gate?"),
        (
            "[gate]\ngate_px = 'wide'",
            "gate.gate_px must be a number, got text 'wide'; `shapepose-fg config` prints",
        ),
        ("[gate]\ngate_px = true", "gate.gate_px must be a number, got true"),
        ("[gate]\ngate_px = nan", "gate.gate_px must be a finite number, got NaN"),
        (
            "[gate]\ngate_px = -2",
            "gate.gate_px must be positive, got -2; `shapepose-fg config` prints the defaults",
        ),
        ("[gate]\nmin_views = 2.5", "gate.min_views must be a whole number, got 2.5"),
        ("gate = 3", "gate must be a table, got 3; write [gate] above its keys"),
        ("weights = [1, 'two']", "weights[1] must be a number, got text 'two'"),
        ("verbose = 1", "verbose must be true or false, got 1"),
        ("kernel = 'welsch'", "kernel must be 'huber' or 'cauchy', got text 'welsch'"),
        (
            "[gate\ngate_px = 3",
            (
                "cannot be read as TOML (Expected ']' at the end of a table declaration (at line "
                "1, column 6)"
            ),
        ),
        ("seed = 1\nseed = 2", "cannot be read as TOML (Cannot overwrite a value"),
    ],
)
def test_bad_settings(tmp_path, text, sentence):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'settings.toml'}: {sentence}")
    assert "\n" not in str(caught.value)


def test_missing_settings(tmp_path):
    with pytest.raises(InputError, match=r"nothing.toml: there is no such file; check the path"):
        read_config(tmp_path / "nothing.toml", Config)


def test_the_pipelines_own_settings(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(toml_text(PipelineConfig()))
    assert read_config(path, PipelineConfig) == PipelineConfig()
    path.write_text("batch_frames = 7\n[people]\ngate_m = 0.2\n")
    config = read_config(path, PipelineConfig)
    assert config == PipelineConfig(batch_frames=7, people=PeopleConfig(gate_m=0.2))
    assert config.candidates.gate_m == 0.2


@pytest.mark.parametrize(
    "old", ["candidates", "proposals", "association", "tracking", "window_graph", "refine"]
)
def test_what_took_the_place_of_old_settings_is_said(tmp_path, old):
    (tmp_path / "old.toml").write_text(f"[{old}]\ngate_m = 0.2\n")
    with pytest.raises(
        InputError,
        match=f"{old} is not a table any more: .*; `shapepose-fg config` prints the defaults",
    ):
        read_config(tmp_path / "old.toml", PipelineConfig)


def test_there_are_few_settings():
    """What a user has no reason to turn is a constant."""

    def count(config) -> int:
        values = [getattr(config, each.name) for each in fields(config)]
        return sum(count(value) if is_dataclass(value) else 1 for value in values)

    body = count(PipelineConfig().body)
    assert count(PipelineConfig()) - body <= 35


def test_values_are_described_in_a_word_or_two():
    values = [
        None,
        True,
        {"a": 1},
        [1, 2, 3],
        "x" * 21,
        "x" * 20,
        float("nan"),
        float("inf"),
        float("-inf"),
        0.5,
    ]
    words = [
        "null",
        "true",
        "an object",
        "a list of 3",
        f"text {'x' * 20!r}...",
        f"text {'x' * 20!r}",
    ]
    words += ["NaN", "Infinity", "-Infinity", "0.5"]
    assert [describe(value) for value in values] == words
