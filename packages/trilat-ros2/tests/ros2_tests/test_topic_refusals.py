"""Files with names of ROS 2 topics that are refused."""

from pathlib import Path

import pytest

from tests.refusals.corpus import Case, parametrize_cases
from trilat_net.errors import UsageError
from trilat_net.log.ros2.topic_names import TopicTable


class TopicCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The TOML text of a file with names of topics, or a missing file."""

    text: str = ""


@parametrize_cases("topics.toml", TopicCase)
def test_invalid_names_of_topics_are_refused(case: TopicCase, tmp_path: Path) -> None:
    if case.text:
        (tmp_path / "names.toml").write_text(case.text, encoding="utf-8")
    with pytest.raises(UsageError) as caught:
        TopicTable.read(str(tmp_path / "names.toml"))
    case.check_message(str(caught.value), caught.value.exit_code)
