import re
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[2] / "docs" / "factors.md"


def test_the_documented_examples_run():
    """All Python of docs/factors.md, one block after the other, as a reader would type it."""
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 5
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(DOCS), "exec"), names)
    # The comment behind `print` in the first example; LM stops within tenths of a millimetre.
    np.testing.assert_allclose(names["solution"].atPoint3(names["wrist"]), [1.0, 0.2, 3.0], atol=1e-3)
