"""Pickles as Python 2 and 3 write them, with chumpy and scipy inside, and pickles that want to run
something.
"""

import io
import os
import pickle
import struct
import sys
import types
from typing import ClassVar

import numpy as np
import pytest
import scipy.sparse

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.errors import InputError


class _Python2Pickler(pickle._Pickler):  # type: ignore[name-defined]
    """Writes bytes and text as Python 2's `str`, and the module names of its time."""

    dispatch: ClassVar[dict] = dict(pickle._Pickler.dispatch)  # type: ignore[attr-defined]

    def save_python2_string(self, value):
        content = value.encode("latin1") if isinstance(value, str) else value
        self.write(b"T" + struct.pack("<i", len(content)) + content)
        self.memoize(value)

    dispatch[bytes] = dispatch[str] = save_python2_string


def python2_pickle(value, protocol: int) -> bytes:
    file = io.BytesIO()
    _Python2Pickler(file, protocol=protocol).dump(value)
    content = file.getvalue()
    for new, old in ((b"numpy._core", b"numpy.core"), (b"sparse._csc", b"sparse.csc")):
        content = content.replace(new, old)
    return content


@pytest.fixture
def chumpy(monkeypatch):
    """A module that pickles as chumpy's arrays do; it is gone again before anything is read."""

    class Ch:
        def __init__(self, **state):
            self.__dict__.update(state)

    class Select(Ch):
        pass

    for cls, name in ((Ch, "chumpy.ch"), (Select, "chumpy.reordering")):
        module = types.ModuleType(name)
        setattr(module, cls.__name__, cls)
        cls.__module__, cls.__qualname__ = name, cls.__name__
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    return types.SimpleNamespace(Ch=Ch, Select=Select)


def assert_same(path, arrays):
    read = BodyModel.load(path).arrays
    np.testing.assert_array_equal(read.template, arrays["v_template"])
    np.testing.assert_array_equal(read.shapes, arrays["shapedirs"])
    np.testing.assert_array_equal(read.pose_blend, arrays["posedirs"])
    np.testing.assert_array_equal(read.joint_regressor, arrays["J_regressor"])
    np.testing.assert_array_equal(read.faces, arrays["f"])


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_numpy_and_scipy(protocol, tmp_path, make_smpl_arrays):
    arrays = make_smpl_arrays()
    content = {
        **arrays,
        "J_regressor": scipy.sparse.csr_matrix(arrays["J_regressor"]),
        "bs_type": "lrotmin",
    }
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    assert_same(tmp_path / "body.pkl", arrays)


@pytest.mark.parametrize("protocol", [0, 2])
def test_official_file_of_python_2(protocol, tmp_path, make_smpl_arrays, chumpy):
    arrays = make_smpl_arrays()
    order = np.random.default_rng(0).permutation(arrays["posedirs"].size)
    source = np.empty(order.size)
    source[order] = arrays["posedirs"].ravel()
    content = {
        **arrays,
        "v_template": np.asfortranarray(arrays["v_template"]),
        "shapedirs": chumpy.Ch(x=arrays["shapedirs"], dirty=True),
        "posedirs": chumpy.Select(a=chumpy.Ch(x=source), idxs=order, preferred_shape=(60, 3, 207)),
        "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
        "J": chumpy.Ch(terms="computed from others, not read"),
        "weights": arrays["weights"].astype(">f8"),
        "vert_sym_idxs": np.arange(60),
        "bs_style": "lbs",
    }
    (tmp_path / "body.pkl").write_bytes(python2_pickle(content, protocol))
    assert protocol == 2 or b"copy_reg" in (tmp_path / "body.pkl").read_bytes()
    for name in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        del sys.modules[name]
    assert_same(tmp_path / "body.pkl", arrays)


def test_chumpy_that_is_computed(tmp_path, make_smpl_arrays, chumpy):
    content = {**make_smpl_arrays(), "shapedirs": chumpy.Ch(left=1, right=2)}
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(InputError, match="shapedirs is not an array"):
        BodyModel.load(tmp_path / "body.pkl")


class Calls:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_that_runs_a_command_is_refused(protocol, tmp_path, make_smpl_arrays):
    proof = tmp_path / "ran"
    content = {**make_smpl_arrays(), "bs_type": Calls(os.system, f"touch {proof}")}
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(
        InputError, match=r"body\.pkl: cannot be read safely \(it asks for (posix|nt)\.system"
    ):
        BodyModel.load(tmp_path / "body.pkl")
    assert not proof.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"c__builtin__\ngetattr\n(S'a'\nS'b'\ntR.",
        b"cnumpy\nload\n(S'x'\ntR.",
        b"cnumpy.testing._private.utils\nrunstring\n(S'1'\n}tR.",
        b"cscipy.sparse\nload_npz\n(S'x'\ntR.",
        b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.size\x93.",
        b"ccopy_reg\n_reconstructor\n(ccopy_reg\n_reconstructor\nc__builtin__\nobject\nNtR.",
    ],
)
def test_names_outside_the_list_are_refused(content, tmp_path):
    (tmp_path / "body.pkl").write_bytes(content)
    with pytest.raises(InputError, match=r"body\.pkl: cannot be read safely"):
        BodyModel.load(tmp_path / "body.pkl")


def test_arrays_of_objects_are_refused(tmp_path, make_smpl_arrays):
    content = {**make_smpl_arrays(), "v_template": np.array([[1, 2, "three"]], dtype=object)}
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(InputError, match="v_template is not an array"):
        BodyModel.load(tmp_path / "body.pkl")


@pytest.mark.parametrize("keep", [0, 1, 100, 5000, -1])
def test_truncated(keep, tmp_path, make_smpl_arrays):
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(make_smpl_arrays())[:keep])
    with pytest.raises(InputError, match=r"body\.pkl: cannot be read"):
        BodyModel.load(tmp_path / "body.pkl")


def test_not_a_dict(tmp_path):
    (tmp_path / "body.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(InputError, match="a list, but SMPL's files hold a dict"):
        BodyModel.load(tmp_path / "body.pkl")


def test_an_array_that_claims_more_than_it_holds(tmp_path, make_smpl_arrays):
    content = pickle.dumps({**make_smpl_arrays(), "v_template": np.zeros((61, 3))}, protocol=2)
    claims = content.replace(
        b"K=K\x03\x86", b"K>K\x03\x86"
    )  # shape (62, 3) over the bytes of (61, 3)
    assert claims != content
    (tmp_path / "body.pkl").write_bytes(claims)
    with pytest.raises(InputError, match="v_template is not an array"):
        BodyModel.load(tmp_path / "body.pkl")
