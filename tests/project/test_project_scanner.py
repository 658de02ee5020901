"""The scanner accepts what the standard library accepts, and knows where everything stands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from neuros.project.scanner import Element, Source, SourceError, parse, place_of, read_file

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


def meaning(text: str) -> Any:
    """What the standard library reads, where it is a value of a project.

    Raises:
        ValueError: for no JSON, a number that is too large for a float, and half a character.
    """
    value = json.loads(text)
    json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
    return value


def scan(text: str) -> Element:
    element, _ = parse(Source("f", Path(), text))
    return element


@settings(max_examples=150)
@given(VALUES, st.sampled_from([None, 0, 2, "\t"]), st.booleans())
def test_a_document_means_what_the_standard_library_says(
    value: object, indent: int | str | None, ascii_only: bool
) -> None:
    text = json.dumps(value, indent=indent, ensure_ascii=ascii_only)
    assert scan(text).plain == json.loads(text)


@settings(max_examples=300)
@example("1e999")
@given(st.text(alphabet='{}[]",: \n\\u0123456789eE+-.truefalsn', max_size=14))
def test_it_accepts_exactly_what_the_standard_library_accepts(text: str) -> None:
    try:
        expected = meaning(text)
    except ValueError:
        with pytest.raises(SourceError):
            scan(text)
    else:
        assert scan(text).plain == expected


@settings(max_examples=100)
@given(VALUES, st.data())
def test_it_agrees_on_damaged_documents(value: object, data: st.DataObject) -> None:
    text = json.dumps(value, indent=1)
    position = data.draw(st.integers(0, len(text) - 1))
    damaged = text[:position] + data.draw(st.sampled_from(["", ",", '"', "]", "}", " "]))
    damaged += text[position + 1 :]
    try:
        expected = meaning(damaged)
    except ValueError:
        with pytest.raises(SourceError):
            scan(damaged)
    else:
        assert scan(damaged).plain == expected


@settings(max_examples=100)
@given(VALUES)
def test_every_value_stands_where_it_says(value: object) -> None:
    def visit(element: Element) -> None:
        assert json.loads(element.text) == element.plain
        members = element.value if isinstance(element.value, dict) else {}
        for key, member in members.items():
            decoded, _ = json.JSONDecoder().raw_decode(element.source.text, member.key_start)
            assert decoded == key
        items = element.value if isinstance(element.value, list) else []
        for child in [*members.values(), *items]:
            visit(child)

    visit(scan(json.dumps(value, indent=2)))


def test_lines_and_columns_count_from_one() -> None:
    element = scan('{\n  "a": [10,\n    20]\n}')
    twenty = element.value["a"].value[1]
    assert twenty.source.place(twenty.start) == (3, 5)
    assert twenty.pointer == "/a/1"


def test_pointers_are_escaped() -> None:
    assert scan('{"a/b~c": 1}').value["a/b~c"].pointer == "/a~1b~0c"


def test_numbers_keep_their_text() -> None:
    assert [item.text for item in scan("[1.0, 1e3, -0]").value] == ["1.0", "1e3", "-0"]


def test_the_last_of_duplicate_keys_counts_and_each_further_one_is_reported() -> None:
    element, duplicates = parse(Source("f", Path(), '{"a": 1,\n "a": 2,\n "a": 3}'))
    assert element.plain == {"a": 3}
    assert [(problem.line, problem.hint) for problem in duplicates] == [
        (2, "first in line 1"),
        (3, "first in line 2"),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f:1:1: /: syntax error: expected a value (the file ends here)"),
        ("{'a': 1}", "f:1:2: /: syntax error: expected a key in double quotes "
                     "(JSON has double quotes only)"),
        ("[1,]", "f:1:3: /: syntax error: a comma before ']' (remove the comma)"),
        ("[1 2]", "f:1:4: /: syntax error: expected ',' or ']' after an item"),
        ('{"a" 1}', "f:1:6: /a: syntax error: expected ':' after the key"),
        ('{"a": tru}', "f:1:7: /a: syntax error: expected a value"),
        ("[NaN]", "f:1:2: /0: syntax error: NaN is not a JSON number"),
        ("[50// Hz", "f:1:4: /: syntax error: expected ',' or ']' after an item "
                     "(JSON has no comments)"),
        ("1 # one", "f:1:3: /: syntax error: there is more text after the end of the document "
                    "(JSON has no comments)"),
    ],
)  # fmt: skip
def test_syntax_errors_say_what_was_expected(text: str, message: str) -> None:
    with pytest.raises(SourceError) as error:
        scan(text)
    assert str(error.value) == message


def test_a_text_of_a_thousand_brackets_is_no_crash() -> None:
    with pytest.raises(SourceError, match="nested too deeply"):
        scan("[" * 1000)


def test_a_file_that_cannot_be_read_is_a_problem(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be read: Is a directory"):
        read_file(tmp_path)


def test_a_pointer_is_found_again_in_its_file(tmp_path: Path) -> None:
    file = tmp_path / "f.json"
    file.write_text('{"a":\n [1, {"b/c": 2}]}')
    assert place_of(file, "/a/1/b~1c") == (2, 14)
    assert place_of(file, "/a/7") == (1, 1)
