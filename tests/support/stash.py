"""What tests leave for the terminal summary."""

import pytest

MEASURED = pytest.StashKey[list]()
