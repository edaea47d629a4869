import subprocess
import sys


def test_the_library_needs_gtsam_and_numpy_only():
    """`factors` is usable by someone who never heard of people: nothing else is imported with
    it.
    """
    code = (
        "import sys, factors\n"
        "heavy = {'torch', 'cv2', 'scipy', 'pydantic', 'rich', 'shapepose_fg'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "missing = [name for name in factors.__all__ if not hasattr(factors, name)]\n"
        "assert not missing, missing\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
