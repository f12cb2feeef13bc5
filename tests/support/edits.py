"""Changes to the text of a configuration."""


def replaced(text: str, *changes: tuple[str, str]) -> str:
    """The text with the first occurrence of each old string replaced by the new one; each must occur."""
    for old, new in changes:
        assert old in text, f"{old!r} is not in the text"
        text = text.replace(old, new, 1)
    return text
