"""What tables in Markdown share."""


def rule(columns: int) -> str:
    """The line under the headings of so many columns."""
    return "|---" * columns + "|"
