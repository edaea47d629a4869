"""One colour per person."""

PALETTE = ("#3f7fb8", "#e0962f", "#2f9e80", "#c06c9c", "#6cb6dd", "#c8623f", "#7d70b8", "#a8a03c")
"""After Okabe and Ito's: apart for every kind of colour vision."""


def rgb(text: str) -> tuple[float, float, float]:
    """Red, green and blue, 0 to 1 in sRGB, of a colour such as `#3f7fb8`."""
    red, green, blue = (int(text[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return red, green, blue


def colour_of(person: int) -> tuple[float, float, float]:
    """The colour of an identity, the same in all files of a result."""
    return rgb(PALETTE[person % len(PALETTE)])
