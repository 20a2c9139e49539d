"""The reader of the corpus: a mistake in a file of cases is an error that names the case."""

from pathlib import Path

import pytest

from tests.refusals.corpus import FOLDER, Case, read_cases

WHOLE = '[[case]]\nname = "a"\npath = "key"\nwords = ["word"]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (WHOLE + 'wrods = ["x"]\n', "case 1 (a): Object contains unknown field `wrods`"),
        (
            WHOLE.replace('path = "key"\n', ""),
            "case 1 (a): Object missing required field `path`",
        ),
        (WHOLE.replace('["word"]', '"word"'), "case 1 (a): Expected `array`, got `str`"),
        (WHOLE.replace("name", "nam"), "case 1 (without a name)"),
        (WHOLE.replace('"a"', '""'), "the name is empty"),
        (WHOLE.replace('"key"', '""').replace('"word"', ""), "path and words are empty"),
        (WHOLE + WHOLE, "case 2 (a): an earlier case has this name"),
        (WHOLE + WHOLE.replace('"a"', '"b"'), "case 2 (b): has the input of the case a"),
        ('folder = "x"\n' + WHOLE, "must consist of tables [[case]]"),
    ],
)
def test_a_mistake_in_a_file_is_an_error(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "cases.toml").write_text(text, encoding="utf-8")
    with pytest.raises(AssertionError) as caught:
        read_cases("cases.toml", Case, tmp_path)
    assert str(caught.value).startswith("cases.toml")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("message", "exit_code"),
    [("word", 2), ("key: other", 2), ("key:\nword", 2), ("key: word", 1)],
)
def test_other_messages_fail_the_case(message: str, exit_code: int) -> None:
    """A message without the place or a word, of two lines, or with another exit code fails."""
    case = Case(name="a", path="key", words=("word",))
    case.check_message("key: word", 2)
    with pytest.raises(AssertionError):
        case.check_message(message, exit_code)


def test_one_test_reads_each_file() -> None:
    root = FOLDER.parents[1]
    folders = [FOLDER, *root.glob("packages/*/tests")]
    sources = [
        path.read_text(encoding="utf-8")
        for folder in folders
        for path in sorted(folder.rglob("test_*.py"))
    ]
    for file in FOLDER.glob("*.toml"):
        mark = f'@parametrize_cases("{file.name}"'
        assert sum(source.count(mark) for source in sources) == 1, file.name
