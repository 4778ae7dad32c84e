"""Names of modes, channels and parameters as people read them."""


def spell(name: str) -> str:
    """Return a name with blanks instead of underscores."""
    return name.replace("_", " ")


def fact(template: str, /, **values: object) -> str:
    """Return a sentence of a result: English, from a template in which values have names.

    Pages translate it by its template (`report.language.sentence`).
    """
    return template.format(**values)
