"""Items of a JSON file that may be larger than memory: as `json` decodes them, mistakes told as by
`read_json`.
"""

import json

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage import files
from shapepose_fg.core.storage.files import read_json
from shapepose_fg.io import json_items
from shapepose_fg.io.json_items import JsonItems

ITEMS = [
    {"a": [1, -2.5e3, 12]},
    {},
    [],
    'Zoë \\ "x" 人',
    None,
    True,
    7,
    1.25,
    {"b": {"c": [[], {}]}},
    float("inf"),
]
PIECES = (1, 2, 3, 7, 50, 2**20)


@pytest.fixture(params=PIECES)
def piece(request, monkeypatch) -> int:
    """Bytes that are read at a time: every place of the files below is a border of two pieces
    once.
    """
    monkeypatch.setattr(files, "PIECE", request.param)
    return request.param


@pytest.mark.parametrize("ascii_only", [True, False])
@pytest.mark.parametrize("indent", [None, 1])
def test_a_list(tmp_path, piece, ascii_only, indent):
    file = tmp_path / "list.json"
    file.write_text(json.dumps(ITEMS, ensure_ascii=ascii_only, indent=indent), encoding="utf-8-sig")
    items = JsonItems(file, ("wanted",))
    assert (items.found, items.key, items.value) == (True, None, None)
    assert list(items) == ITEMS


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_list_in_an_object(tmp_path, piece, place):
    others = [("first", {"x": 1}), ("second", [1, 2])]
    file = tmp_path / "object.json"
    members = [*others[:place], ("wanted", ITEMS), *others[place:]]
    file.write_text(json.dumps(dict(members)), encoding="utf-8")
    items = JsonItems(file, ("other", "wanted"))
    assert (items.found, items.key, items.others) == (True, "wanted", dict(others[:place]))
    assert list(items) == ITEMS
    assert items.others == dict(others)


@pytest.mark.parametrize(
    ("text", "value", "key"),
    [
        ("3", 3, None),
        ('"x"', "x", None),
        ("{}", {}, None),
        ('{"a": [1]}', {}, None),
        ('{"wanted": 3}', 3, "wanted"),
    ],
)
def test_no_such_list(tmp_path, piece, text, value, key):
    file = tmp_path / "other.json"
    file.write_text(f" {text}\n")
    items = JsonItems(file, ("wanted",))
    assert (items.found, items.value, items.key, list(items)) == (False, value, key, [])


def test_nothing_in_the_list(tmp_path, piece):
    for text in ("[ ]", '{"wanted": [\n]}'):
        (tmp_path / "empty.json").write_text(text)
        assert list(JsonItems(tmp_path / "empty.json", ("wanted",))) == []


MISTAKES = [
    "[{]", '[1, 2', '[1,\n 2,\n x]', '[{"a": 1}\n {"a": 2}]', '["unfinished', '[tru]', "[1]]",
    "[1] 2", '{"wanted": [1, 2]', '{"wanted": [1], "x": }', '{"wanted": [1]} }',
    '{"x": 1 "wanted": []}', '{"x": tru}', '["\\u00e"]', '["\\x"]', '[\n\n  "a\tb"]', "",  "  \n",
    "[nul", "[1 2]", '{"a"', '{1: 2}', "[\n1,\n\n 2 3]", '{"x": 1, "x": 2}',
    '{"wanted": [], "wanted": []}', '[{"a": 1, "a": 2}]', '[' + "[" * 70 + "]" * 71,
]  # fmt: skip


@pytest.mark.parametrize("text", MISTAKES)
def test_mistakes_are_told_as_of_a_whole_file(tmp_path, piece, text):
    file = tmp_path / "bad.json"
    file.write_text(text)
    with pytest.raises(InputError) as whole:
        read_json(file)
    with pytest.raises(InputError) as caught:
        list(JsonItems(file, ("wanted",)))
    assert str(caught.value) == str(whole.value)


def test_text_that_is_none(tmp_path, piece):
    file = tmp_path / "latin.json"
    file.write_bytes('["abc", "Zoë"]'.encode("latin-1"))
    with pytest.raises(InputError, match="byte 11 is not UTF-8 text"):
        list(JsonItems(file, ()))


def test_long_numbers(tmp_path, piece):
    (tmp_path / "long.json").write_text(f'[1, {{"a": {2**70}}}]')
    with pytest.raises(InputError, match=r"a is a whole number of over 18 digits"):
        list(JsonItems(tmp_path / "long.json", ()))


def test_one_value_that_does_not_end(tmp_path, monkeypatch):
    monkeypatch.setattr(json_items, "MIDDLE", 2**20)
    (tmp_path / "long.json").write_text('[1,\n"' + "x" * 2**22)
    with pytest.raises(InputError, match="one value has over 1 MiB"):
        list(JsonItems(tmp_path / "long.json", ()))
