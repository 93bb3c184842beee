"""Size of the package: lines, the longest files, comments per 100 lines.

Exits with 1 above `MOST_LINES` in all, or where a file is longer than `LONGEST`.
"""

import io
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_LINES, LONGEST = 15_000, 300


def count_comments(text: str) -> int:
    """Comments of a file."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(token.type == tokenize.COMMENT for token in tokens)


def measure(folder: Path) -> tuple[dict[str, int], int]:
    """Lines of every Python file in a folder, by path, and comments in all."""
    lines, comments = {}, 0
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text()
        lines[str(path.relative_to(folder))] = len(text.splitlines())
        comments += count_comments(text)
    return lines, comments


def main() -> int:
    """Print the sizes, and return the exit status."""
    lines, comments = measure(ROOT / "torchrl_nerd")
    total, long = sum(lines.values()), [p for p in lines if lines[p] > LONGEST]
    longest = max(lines, key=lambda path: lines[path])
    print(f"{total} lines in {len(lines)} files (at most {MOST_LINES})")
    print(f"longest file: {longest}, {lines[longest]} lines (at most {LONGEST})")
    print(f"{100 * comments / total:.1f} comments per 100 lines")
    parts: dict[str, int] = {}
    for path, count in lines.items():
        part = Path(path).parts[0]
        parts[part] = parts.get(part, 0) + count
    for part, count in sorted(parts.items(), key=lambda item: -item[1]):
        print(f"{count:>6}  {part}")
    for path in long:
        print(f"too long: {path}, {lines[path]} lines")
    return int(total > MOST_LINES or bool(long))


if __name__ == "__main__":
    sys.exit(main())
