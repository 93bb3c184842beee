"""Tables for the terminal."""

from collections.abc import Sequence


def text_table(
    head: Sequence[str], body: Sequence[Sequence[str]], titles: Sequence[str] = ()
) -> str:
    """Lines with aligned columns, the first two to the left.

    ``titles``: above the columns after the first two, each as wide as three at most.
    """
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if number < 2 else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in (head, *body)
    ]
    if titles:
        above = " " * (widths[0] + widths[1] + 2)
        for at, title in enumerate(titles):
            if title:
                above = above.ljust(sum(widths[: at + 2]) + 2 * (at + 2)) + title
        lines.insert(0, above)
    return "\n".join(lines)
