from pathlib import Path

import pytest
from study_builders import QUICK


@pytest.fixture
def quick_file(tmp_path: Path) -> Path:
    """The quick scenario as a file."""
    path = tmp_path / "quick.toml"
    path.write_text(QUICK)
    return path
