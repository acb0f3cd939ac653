"""Fixtures that several test files share."""

from pathlib import Path

import hypothesis
import pytest

# A failure must be the same failure on the next run, and a slow machine is no failure.
hypothesis.settings.register_profile("igsr", derandomize=True, deadline=None)
hypothesis.settings.load_profile("igsr")


@pytest.fixture(scope="session")
def example_path() -> Path:
    """The capture that is committed as an example."""
    return Path(__file__).parent.parent / "examples" / "tea_table"
