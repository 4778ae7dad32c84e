"""Names of modes, channels and parameters as people read them."""


def spell(name: str) -> str:
    """Return a name with blanks instead of underscores."""
    return name.replace("_", " ")
