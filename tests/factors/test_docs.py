import re
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[2] / "docs" / "factors.md"


def test_the_documented_examples_run(tmp_path, monkeypatch):
    """All Python of docs/factors.md, one block after the other, as a reader would type it."""
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 8
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(DOCS), "exec"), names)
    # The comment behind `print` in the first example; LM stops within tenths of a millimetre.
    np.testing.assert_allclose(
        names["solution"].atPoint3(names["wrist"]), [1.0, 0.2, 3.0], atol=1e-3
    )
    for solver in ("isam", "smoother"):
        # 8 pixels are 8 cm of depth, 1 m apart at 3 m; 12 frames tell of them, and the pose adds 4
        # cm.
        off = names[solver].calculateEstimate().atPoint3(names["wrist_now"]) - [0.7, 0.4, 3.1]
        covariance = names["isam"].marginalCovariance(names["wrist_now"])
        assert np.sqrt(np.trace(covariance)) < 0.15
        assert off @ np.linalg.solve(covariance, off) < 25  # of a Gaussian one in 65,000 is farther
    assert (
        names["again"].size() == names["isam"].getFactorsUnsafe().size()
        and "person 7" in names["dot"]
    )
