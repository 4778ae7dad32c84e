"""Text of files in messages."""

from lmshealth.io.refusal import listed


def test_listed():
    """Long lists are cut and control characters made visible."""
    assert listed(str(i) for i in range(14)).endswith("11 and 2 more")
    assert listed(["a\x1b"]) == "'a\\x1b'" and listed([]) == "nothing"
